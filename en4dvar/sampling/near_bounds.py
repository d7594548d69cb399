r"""The posterior where priors end at bounds, by predictions that are linear in what is bounded.

    m(x) ≈ m(x̂) + G (s(x) − s(x̂)),   s = θ where a prior ends at a bound (ln θ of a lognormal), else x

Such a prior is Gaussian in its score x = Φ⁻¹(F(θ)), which is bent at the bound, and a posterior within few standard
deviations of it is no Gaussian about its mode x̂, however linear the model: the Gaussian lies off the bound, for θ
hardly changes with x there. With these predictions J costs no run, and its posterior is drawn as an emulated one is.
The members' own runs then say how good it is. Of Gaussian errors W(y − m)/σ, W of no state, the triangle of a QR
decomposition of W [G, y − m(x̂)] says the same as all readings.
"""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from en4dvar.data.noise import Linearisation, Predicted
from en4dvar.data.observations import Observations
from en4dvar.descent.beyond_gaussian import Drawn
from en4dvar.descent.weight_space import WeightSpace
from en4dvar.diagnosis.diagnostics import effective_share
from en4dvar.ensemble.forecast import of_framework
from en4dvar.ensemble.linalg import with_moments
from en4dvar.model.state import NOISE_SCALE, Array
from en4dvar.priors.parameter_map import QUANTILE_MAPS
from en4dvar.priors.prior import Prior, member_stream
from en4dvar.sampling.emulated_draws import EmulatedProposal
from en4dvar.sampling.mixture import StudentMixture

STRAIGHT = 0.995  # effective share of the members for which predictions may as well be linear in x
NARROWEST = 1e7  # how many times wider the posterior may be in one direction than in another
LEFT_OUT, KEPT = 3, 6  # turns of the walkers
MANY = 500  # readings of other errors than Gaussian ones of known ratios, of which J of all walkers takes seconds


def near_bounds(space: WeightSpace, linear: Linearisation, mode: Array, posterior: Array) -> Drawn | None:
    """Members (N, n) in place of ``posterior`` (N, n), the Gaussian about the ``mode`` (n,), all transformed.

    None where predictions that are linear in x say the same, where these are too many or not known in all directions,
    where one is so narrow that no covariance has the digits for it, and where the posterior is a mixture of its own:
    beside an estimated discrepancy or scale of what varies.
    """
    problem, prior = space.problem, space.problem.prior
    mixed = problem.discrepancy or any(walk.spread for walk in problem.walks)
    ending = [t.transform in QUANTILE_MAPS and t.parameter.name != NOISE_SCALE.name for t in prior.terms]
    bent = np.flatnonzero(ending).tolist()
    if mixed or not bent or space.basis.shape[1] < len(mode):
        return None
    parts = [part for part in (linear.anomalies, linear.rate_anomalies) if part is not None]
    slopes = np.asarray(np.linalg.solve(space.basis.T @ space.anomalies, np.hstack(parts)), dtype=float)
    of_readings = _cost_of_readings(problem.observations, linear.prediction, slopes)
    if of_readings is None:
        return None
    bend = _bend(prior, bent, mode)

    def cost(x: Array, change: Array | None = None) -> Array:
        """J (B,) at control vectors (B, n), of predictions that change by ``change`` (B, n), or those bent."""
        scaled = problem.has_noise_scale
        sigma = of_framework(problem, prior.to_physical(x), NOISE_SCALE, 1.0) if scaled else np.ones(len(x))
        return np.asarray(prior.cost(x) + of_readings(bend(x) if change is None else change, sigma))

    if effective_share(cost(posterior, posterior - mode) - cost(posterior)) > STRAIGHT:
        return None
    white, stream = prior.white(posterior), member_stream(space.seed, "near bounds")
    if np.linalg.cond(white - white.mean(axis=0)) > NARROWEST:
        return None
    start = StudentMixture.fitted(white, stream, 1)
    turns = [EmulatedProposal.bridged_from(start, lambda z: cost(prior.from_white(z)), stream)]
    for _ in range(LEFT_OUT + KEPT):
        turns.append(turns[-1].settled(stream))
    draws = prior.from_white(np.concatenate([turn.walkers for turn in turns[-KEPT:]]))
    # evenly along what is bent most, so that few members have its quantiles
    bends = np.std(bend(posterior) - posterior, axis=0) / np.std(posterior, axis=0)
    most = bent[int(np.argmax(bends[bent]))]
    even = ((np.arange(len(posterior)) + 0.5) * len(draws) / len(posterior)).astype(int)
    members = draws[np.argsort(draws[:, most])[stream.permutation(even)]]
    if space.settings.sampling == "exact":
        members = with_moments(members, draws.mean(axis=0), np.linalg.cholesky(np.atleast_2d(np.cov(draws.T))).T)
    log = float(np.mean([turn.log for turn in turns[-KEPT:]])) - 0.5 * len(mode) * math.log(2 * math.pi)
    return Drawn(members, cost, log)


def _cost_of_readings(
    observations: Observations, at: Predicted, slopes: Array
) -> Callable[[Array, Array], Array] | None:
    """J_o (B,) of changes (B, n) from the prediction ``at`` the mode, by ``slopes`` (n, K) and beside them those of the
    rates, and of σ (B,); None where it takes too long.
    """
    like = replace(at, noise_scale=None).each(lambda part: np.asarray(part)[None])
    if observations.noise.quadratic and like.rates is None:
        rows = observations.whitened_rows(np.vstack([slopes, observations.values - at.values]), like)[0]
        triangle, weight = np.asarray(np.linalg.qr(rows.T, mode="r")), float(observations.weights.sum())

        def of_triangle(change: Array, sigma: Array) -> Array:
            white = triangle[:, -1] - change @ triangle[:, :-1].T
            with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
                total = 0.5 * np.sum(white**2, axis=1) / sigma**2 + weight * np.log(sigma)
            return np.where(np.isfinite(total), total, np.inf)

        return of_triangle
    if len(observations) > MANY:
        return None

    def of_all(change: Array, sigma: Array) -> Array:
        return observations.cost(replace(like.unstacked(like.stacked + change @ slopes), noise_scale=sigma))

    return of_all


def _bend(prior: Prior, bent: list[int], mode: Array) -> Callable[[Array], Array]:
    """(s(x) − s(x̂))/s'(x̂) (B, n) of control vectors (B, n); in the other coordinates x − x̂."""

    def bend(x: Array) -> Array:
        change = x - mode
        for j in bent:
            term = prior.terms[j]
            s, at, slope = term.to_physical(x[:, j]), term.to_physical(mode[j]), term.slope(float(mode[j]))
            if term.transform == "bounded-lognormal":
                s, at, slope = np.log(s), np.log(at), slope / float(at)
            change[:, j] = (s - at) / slope
        return change

    return bend
