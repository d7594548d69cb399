"""Readings that the model gives of some members and not of others: each is regressed on the members that have it.

With x the control vectors, a reading that is an affine function of x has the value that the model would have given; one
that is not has that of its tangent over the members. A fit of the reading on x by least squares does not change by it,
so that a Gauss–Newton step weighs each reading by the members that have it. Where x has more coordinates than there are
members, as a field has, the fit is on those that the reading is correlated with most: fewer than a quarter of the
members that have it. Sources: Little & Rubin (2019), Statistical Analysis with Missing Data, § 2.4 (least squares with
missing responses) and § 4.2 (regression imputation); Fan & Lv (2008), J. R. Stat. Soc. B 70, 849 (screening).
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from en4dvar.ensemble.forecast import NO_TIMES, Forecast
from en4dvar.ensemble.linalg import min_norm_fit
from en4dvar.model.state import Array
from en4dvar.priors.prior import Prior, member_stream

CHANCE = 3.0  # correlations below this over √N are taken for chance
FITTED = 4  # members that have a reading for each coordinate that it is fitted on
PART = 1 << 22  # numbers of x that are worked on at once


def filled(run: Forecast, x: Array) -> Forecast:
    """The forecast of control vectors ``x`` (B, n) with the readings, rates and curves that some members lack.

    A member that lacks all, has an infinite one or failed for another reason is left as it is, and so is one that the
    others do not determine, see :func:`fitted`.
    """
    partial = run.partial
    return _completed(run, partial, lambda values: fitted(x, values)) if partial.any() else run


def _completed(run: Forecast, partial: Array, fill: Callable[[Array], Array]) -> Forecast:
    """What ``fill`` makes of the values (B, K) of all members that run, in those that are ``partial`` (B,)."""
    predicted, runs = run.predicted, np.logical_or(run.active, partial)
    k = predicted.values.shape[1]
    rates = np.empty((len(run), 0)) if predicted.rates is None else predicted.rates
    values = np.hstack([predicted.values, rates, run.path])
    values[runs] = fill(np.where(runs[:, None], values, np.nan))[runs]
    whole = np.logical_and(partial, np.isfinite(values).all(axis=1))
    lacking = np.flatnonzero(np.isnan(values[runs, :k]).any(axis=0))
    values[np.logical_and(partial, ~whole)] = np.nan
    return replace(
        run,
        predicted=replace(
            predicted, values=values[:, :k], rates=values[:, k : 2 * k] if predicted.rates is not None else None
        ),
        path=values[:, values.shape[1] - run.path.shape[1] :],
        failures=tuple("" if full else reason for full, reason in zip(whole, run.failures, strict=True)),
        filled=float(np.isnan(run.predictions[whole]).sum() / max(run.predictions[runs].size, 1)),
        lacking=tuple(lacking.tolist()),
    )


class Beside:
    """𝓗 of each control vector by itself: what a run lacks is regressed on runs close to it, ``epsilon`` prior stds.

    A reading that none of these has stays missing, and with it the member is lost. ``forward_runs``: of all.
    """

    def __init__(self, composite: Callable[[Array, Array], Forecast], prior: Prior, epsilon: float):
        self.composite, self.prior, self.epsilon, self.forward_runs = composite, prior, epsilon, 0

    def __call__(self, x: Array, extra_times: Array = NO_TIMES) -> Forecast:
        run = self.composite(x, extra_times)
        self.forward_runs += len(x)
        rows, n = np.flatnonzero(run.partial), x.shape[1]
        if not len(rows):
            return run
        steps = member_stream(0, "missing readings").standard_normal((2 * FITTED * (n + 1), n))
        around = self.prior.white(x[rows])[:, None] + self.epsilon * steps
        near = self.composite(self.prior.from_white(around.reshape(-1, n)), extra_times)
        self.forward_runs += len(near)
        rates = () if near.predicted.rates is None else (near.predicted.rates,)
        values_near = np.hstack([near.predictions, *rates, near.path]).reshape(len(rows), len(steps), -1)

        def fill(values: Array) -> Array:
            for row, own in zip(rows.tolist(), values_near, strict=True):
                values[row] = fitted(np.vstack([np.zeros(n), steps]), np.vstack([values[row], own]))[0]
            return values

        return _completed(run, run.partial, fill)


def fitted(x: Array, values: Array, ran: Array | None = None) -> Array:
    """``values`` (B, K) of points ``x`` (B, n), those that are NaN by affine regression on the others of their column.

    ``ran`` (B,): the points that shall have values, by default those with one at least; a point with an infinite value
    stays as it is. NaN stays, too, where the points that have a value span fewer directions than all of them, and of
    fields where fewer than five have one.
    """
    if np.isfinite(values).all():
        return values
    some = np.isfinite(values).any(axis=1) if ran is None else ran
    rows = np.logical_and(some, np.logical_not(np.isinf(values).any(axis=1))).astype(bool)
    values, own = values.copy(), values[rows]
    values[rows] = _regressed(x[rows], own) if x.shape[1] + 1 < len(own) else _screened(x, rows, own)
    return values


def _regressed(x: Array, values: Array) -> Array:
    spread = x.std(axis=0)
    moving = spread > 0
    design = np.column_stack([np.ones(len(x)), (x - x.mean(axis=0))[:, moving] / spread[moving]])
    rank, lacks = np.linalg.matrix_rank(design), np.isnan(values)
    patterns, which = np.unique(lacks, axis=1, return_inverse=True)
    for lacking, columns in ((patterns[:, i], which.ravel() == i) for i in range(patterns.shape[1])):
        has = ~lacking
        if lacking.any() and has.any() and np.linalg.matrix_rank(design[has]) == rank:
            fit = min_norm_fit(design[has], values[np.ix_(has, columns)])
            values[np.ix_(lacking, columns)] = design[lacking] @ fit
    return values


def _screened(x: Array, rows: Array, values: Array) -> Array:
    """The same of ``rows`` (B,) of x (B, n), on the coordinates that each column is correlated with most."""
    columns = np.flatnonzero(np.isnan(values).any(axis=0))
    has = ~np.isnan(values[:, columns])
    count, shares = has.sum(axis=0), has / np.maximum(has.sum(axis=0), 1)
    y = np.where(has, values[:, columns] - np.nansum(values[:, columns] * shares, axis=0), 0.0)
    most = np.maximum(count // FITTED - 1, 1)
    chosen = [(np.empty(0), np.empty((len(values), 0)))] * len(columns)
    step = max(1, PART // len(values))
    for first in range(0, x.shape[1], step):
        part = x[:, first : first + step][rows]
        part = part - part.mean(axis=0)
        variance = np.maximum((part**2).T @ shares - (part.T @ shares) ** 2, np.finfo(float).tiny)
        size = np.abs(part.T @ (y * shares)) / np.sqrt(variance * np.maximum((y * y * shares).sum(axis=0), 1e-300))
        for k, (known, features) in enumerate(chosen):
            top = np.argsort(-size[:, k], kind="stable")[: most[k]]
            sizes = np.concatenate([known, size[top, k]])
            best = np.argsort(-sizes, kind="stable")[: most[k]]
            chosen[k] = sizes[best], np.hstack([features, part[:, top]])[:, best]
    for k in np.flatnonzero(count > FITTED).tolist():
        sizes, features = chosen[k]
        told = max(1, int(np.sum(sizes > CHANCE / np.sqrt(count[k]))))
        design = np.column_stack([np.ones(len(values)), features[:, :told]])
        fit = min_norm_fit(design[has[:, k]], values[has[:, k]][:, columns[k]])
        values[~has[:, k], columns[k]] = design[~has[:, k]] @ fit
    return values
