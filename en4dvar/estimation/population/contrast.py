r"""Centres of several populations drawn together, so that what they have in common cancels in their differences.

Each population k has by itself draws of its centre x_k (the transformed median) and of common quantities θ ~ N(0, I),
white. With Gaussian θ and a regression of x_k on θ, or of its exponential
(:mod:`~en4dvar.estimation.population.following`), they say

    p(x_k, θ | data_k) = N(θ; m_k, S_k) · [x_k = c_k θ + r_k],

with the r_k as they were drawn. Quantities that several populations share have one value in all of them, their prior
counts once, and the populations' information about them adds:

    θ | all data ~ N(P⁻¹ h, P⁻¹),    P = I + Σ_k (S_k⁻¹ − I),    h = Σ_k S_k⁻¹ m_k.

For a linear Gaussian hierarchy this is exact (product of the posteriors over the shared prior). A spread that is known
badly makes r_k anything but Gaussian, which is kept.
"""

from collections.abc import Hashable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from en4dvar.ensemble.linalg import effective_number, resampled, shares_of
from en4dvar.estimation.population.campaign import FEWEST
from en4dvar.estimation.population.following import following_of
from en4dvar.model.state import Array
from en4dvar.priors.prior import member_stream


@dataclass(frozen=True)
class Centre:
    """What one population says by itself: draws ``x`` (M,) of its transformed median and ``theta`` (M, c) of its common
    quantities, white; ``common`` (c,) tells these apart: equal ones are one quantity. ``x`` has a flat prior unless
    ``pulled`` by its hyperprior. ``log``: the prior standard deviation of the logarithm of a positive parameter, or 0.
    """

    x: Array
    theta: Array
    common: tuple[Hashable, ...]
    pulled: bool = False
    log: float = 0.0


def without_pull(
    at: int, nu: Array, theta: Array, common: tuple[Hashable, ...], mean_std: float, draws: float, seed: int,
    known: Sequence[tuple[int, float, float]] = (), log: float = 0.0,
) -> Centre:  # fmt: skip
    """The centre in column ``at`` of the draws ``nu`` (M, p) without their hyperprior N(0, ``mean_std``²), which pulls
    populations together; with it where fewer than a hundred of the effective ``draws`` would count.

    ``known``: columns of ``nu`` with value and standard deviation from elsewhere, by a rheometer for instance.
    """
    shares = shares_of(0.5 * np.sum((nu / mean_std) ** 2, axis=1))
    pulled = effective_number(shares) / len(shares) * draws < FEWEST
    both = np.hstack([nu, theta])
    if not pulled:
        stream = member_stream(seed, "without the pull of the hyperprior")
        both = both[resampled(shares, len(shares), stream)]
    for column, value, std in known:
        both = knowing(both, column, value, std, seed)
    return Centre(both[:, at], both[:, nu.shape[1] :], common, pulled, log)


def knowing(draws: Array, column: int, value: float, std: float, seed: int) -> Array:
    """Draws (M, n) once one ``column`` is known from elsewhere to be ``value`` ± ``std``: by linear regression, with a
    reading of its own for each draw (the update of an ensemble Kalman filter; exact for Gaussian ones).
    """
    apart = draws[:, column] - draws[:, column].mean()
    reading = value + std * member_stream(seed, f"known {column}").standard_normal(len(draws))
    gain = apart @ (draws - draws.mean(axis=0)) / len(draws) / (apart.var() + std**2)
    return np.asarray(draws + np.outer(reading - draws[:, column], gain))


def drawn_together(centres: Sequence[Centre], seed: int) -> Array:
    """(M, K) draws of the transformed medians of all populations, given the data of all; M those of the first."""
    known = list(dict.fromkeys(name for centre in centres for name in centre.common))
    precision, information = np.eye(len(known)), np.zeros(len(known))
    for centre in centres:
        if centre.common:
            where = [known.index(name) for name in centre.common]
            # S⁻¹ of draws, not below that of the prior: data only add information, and the rest is noise of the draws
            values, vectors = np.linalg.eigh(np.atleast_2d(np.cov(centre.theta.T)))
            mean, told = centre.theta.mean(axis=0), (vectors / np.minimum(values, 1.0)) @ vectors.T
            precision[np.ix_(where, where)] += told - np.eye(len(where))
            information[where] += told @ mean
    stream, count = member_stream(seed, "populations together"), len(centres[0].x)
    root = np.linalg.cholesky(np.linalg.inv(precision))
    theta = np.linalg.solve(precision, information) + stream.standard_normal((count, len(known))) @ root.T
    columns, possible = [], np.full(count, True)
    for centre in centres:
        x, centred = centre.x[:, None], centre.theta - centre.theta.mean(axis=0)

        def slopes(of: Sequence[Array], centred: Array = centred) -> Array:
            return np.asarray(np.linalg.lstsq(centred, of[0] - of[0].mean(axis=0), rcond=None)[0].T)

        following = following_of([x], [centre.theta], np.array([centre.log]), slopes)
        rest = following.own(x, centre.theta)[stream.integers(len(x), size=count)]
        common = theta[:, [known.index(name) for name in centre.common]]
        columns.append(following.together(rest, common))
        possible &= np.isclose(following.own(columns[-1], common), rest)[:, 0]  # nothing positive is taken away whole
    together = np.hstack(columns)
    some = 0 < np.sum(possible) < count
    return together[possible][stream.integers(np.sum(possible), size=count)] if some else together


@dataclass(frozen=True)
class StraightLine:
    """Populations' centres as a straight line of a number: draws (M,) of ``slope`` and of ``level`` at number 0.

    ``misfit``: χ² of the centres about the line, of ``freedom`` degrees; ``chance``: of one as large.
    Where χ² exceeds ``freedom`` both are wider by the square root of their ratio (Birge 1932, Phys. Rev. 40, 207), for
    the populations then differ by more than the line says.
    """

    slope: Array
    level: Array
    misfit: float
    freedom: int

    @property
    def chance(self) -> float:
        return float(chi2.sf(self.misfit, self.freedom)) if self.freedom else 1.0


def line(x: Array, numbers: Array) -> StraightLine:
    """Through draws ``x`` (M, K) at ``numbers`` (K,), by generalised least squares with the covariance of the draws.

    Raises :class:`ValueError`: all numbers are the same.
    """
    if np.ptp(numbers) == 0:
        raise ValueError("a line needs populations of at least two different numbers")
    design = np.stack([np.ones(len(numbers)), numbers], axis=1)
    weighed = np.linalg.solve(np.cov(x.T), design)
    fit = np.linalg.solve(design.T @ weighed, weighed.T)  # (2, K)
    drawn, middle = x @ fit.T, x.mean(axis=0) @ fit.T
    apart, freedom = x.mean(axis=0) - design @ middle, len(numbers) - 2
    misfit = float(apart @ np.linalg.solve(np.cov(x.T), apart))
    wider = np.sqrt(max(1.0, misfit / freedom)) if freedom else 1.0
    drawn = middle + wider * (drawn - middle)
    return StraightLine(drawn[:, 1], drawn[:, 0], misfit, freedom)
