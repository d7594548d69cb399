"""Readings that the model gives of some members and not of others: each is regressed on the members that have it.

With x the control vectors, a reading that is an affine function of x has the value that the model would have given; one
that is not has that of its tangent over the members. A fit of the reading on x by least squares does not change by it,
so that a Gauss–Newton step weighs each reading by the members that have it. Source: Little & Rubin (2019), Statistical
Analysis with Missing Data, § 2.4 (least squares with missing responses) and § 4.2 (regression imputation).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from en4dvar.ensemble.forecast import Forecast
from en4dvar.ensemble.linalg import min_norm_fit
from en4dvar.model.state import Array


def filled(run: Forecast, x: Array) -> Forecast:
    """The forecast of control vectors ``x`` (B, n) with the readings, rates and curves that some members lack.

    A member that lacks all, has an infinite one or failed for another reason is left as it is, and so is one that the
    others do not determine: where those that have the reading span fewer directions than all that run.
    """
    partial = run.partial
    if not partial.any():
        return run
    predicted, rows = run.predicted, np.flatnonzero(np.logical_or(run.active, partial))
    k = predicted.values.shape[1]
    rates = np.empty((len(run), 0)) if predicted.rates is None else predicted.rates
    values = np.hstack([predicted.values, rates, run.path])
    values[rows] = fitted(x[rows], values[rows])
    whole = np.logical_and(partial, np.isfinite(values).all(axis=1))
    values[np.logical_and(partial, ~whole)] = np.nan
    return replace(
        run,
        predicted=replace(
            predicted, values=values[:, :k], rates=values[:, k : 2 * k] if predicted.rates is not None else None
        ),
        path=values[:, values.shape[1] - run.path.shape[1] :],
        failures=tuple("" if full else reason for full, reason in zip(whole, run.failures, strict=True)),
        filled=float(np.isnan(run.predictions[whole]).sum() / max(run.predictions[rows].size, 1)),
    )


def fitted(x: Array, values: Array) -> Array:
    """``values`` (B, K) of points ``x`` (B, n), those that are NaN by affine regression on the others of their column.

    NaN stays where the points that have a value span fewer directions than all of them.
    """
    values, spread = values.copy(), x.std(axis=0)
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
