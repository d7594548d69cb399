r"""Expected information by simulated readings, each of which is explained anew.

Draw i of the prior predicts m_i and is read as y_i. With z = (a, b), a what is asked and b what else is unknown,

    g_i = ln p(y_i | a_i) − ln p(y_i),     p(y) = ∫ e^{−J_o} N(u; 0, I) du,     p(y | a) = ∫ e^{−J_o} N(b; 0, I) db,

both by importance sampling with runs of their own about the posterior of y_i (never with those of other draws, whose
number N would bound the result by ln N). Of M draws of weight w the logarithm of their mean is too small by
var(w)/(2 M w̄²), which is added; what remains is O(M⁻²) (Rainforth et al. 2018, ICML, on nested estimates).

Were the prediction linear with the sensitivities S of draw i, g_i would be a constant and, with the whitened errors e,

    c_i = ½ q(S, e + S u) − ½ q(S_b, e + S_b b),     q(S, v) = vᵀ (I + SSᵀ)⁻¹ v.

With A = I − (I + SᵀS)⁻¹ the mean of q over e and u is that of the number of readings if the part uᵀ(A − Ā)u − tr(A − Ā)
is left out, Ā the mean over the draws; so is it of S_b. Such c has no expectation and is subtracted from g (a control
variate): the spread that is left is that of what is not linear.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from en4dvar.design.laplace import about, precision, require_alive, standard_error
from en4dvar.design.planned import Planned
from en4dvar.prior import member_stream
from en4dvar.sampling.importance import FEWEST, Importance
from en4dvar.sampling.mixture import StudentMixture
from en4dvar.state import Array

ROUNDS = 4  # of proposals, while few draws have a weight
FROM_PRIOR = 0.1  # share of a proposal that is the prior's: a second minimum is found, no weight is without bound
WIDER = 1.2  # than the Gaussian that it is made of


@dataclass(frozen=True)
class Nested:
    """``gains`` (R,) of simulated readings less their control variate, nats; ``linearised`` (R,) at the same draws;
    ``effective`` (R,) importance draws behind each.
    """

    gains: Array
    linearised: Array
    effective: Array

    @property
    def gain(self) -> float:
        """Expected information, nats."""
        return float(self.gains.mean())

    @property
    def error(self) -> float:
        """Monte Carlo standard error of :attr:`gain`."""
        return standard_error(self.gains)

    @property
    def correction(self) -> tuple[float, float]:
        """What the gain has more than Laplace's estimate at the same draws, and the standard error of that."""
        difference = self.gains - self.linearised
        return float(difference.mean()), standard_error(difference)


def nested(planned: Planned, u: Array, inner: int, seed: int) -> Nested:
    """From draws (R, n) of the prior, one simulated set of readings and ``inner`` runs (a round) each.

    Raises :class:`TooFewMembersError` where the model mostly fails.
    """
    truths = planned.tangents(u)
    require_alive(len(truths.at), len(u))
    noise = planned.problem.observations.noise
    streams = [member_stream(seed, "design readings", int(i)) for i in truths.alive]
    values = np.stack([noise.drawn(one.prediction, s) for one, s in zip(truths.at, streams, strict=True)])
    d, rows = truths.whitened(planned, values)
    matrices = precision(rows)
    pull = np.einsum("rki,rk->ri", rows, d + np.einsum("rki,ri->rk", rows, truths.u))
    centres = np.linalg.solve(matrices, pull[..., None])[..., 0]
    plain, effective = np.empty(len(values)), np.empty(len(values))
    for i, (y, stream) in enumerate(zip(values, streams, strict=True)):
        plain[i], effective[i] = _gain(planned, y, truths.u[i], centres[i], matrices[i], inner, stream)
    alive = np.isfinite(plain)
    require_alive(int(alive.sum()), len(u))
    gains = plain - control_variate(d, truths.whitened(planned)[1], truths.u, planned.asked)
    linearised = 0.5 * np.linalg.slogdet(about(matrices, planned.asked))[1]
    return Nested(gains[alive], linearised[alive], effective[alive])


def _gain(
    planned: Planned, values: Array, truth: Array, centre: Array, matrix: Array, inner: int, stream: np.random.Generator
) -> tuple[float, float]:
    """ln p(y | a) − ln p(y) of readings (K,), and the effective draws behind it; N(centre, M⁻¹) is near."""
    known, effective = _log_integral(planned, values, truth[: planned.asked], centre, matrix, inner, stream)
    log, of_all = _log_integral(planned, values, truth[:0], centre, matrix, inner, stream)
    return known - log, min(effective, of_all)


def _log_integral(
    planned: Planned, values: Array, known: Array, centre: Array, matrix: Array, inner: int, stream: np.random.Generator
) -> tuple[float, float]:
    """ln ∫ e^{−J_o} N(·; 0, I) over the coordinates behind the ``known`` ones, and the effective draws behind it."""
    k, n = len(known), len(centre)
    if k == n:
        return -float(planned.cost(values, planned.run(known[None]))[0]), np.inf
    own = matrix[k:, k:]
    middle = centre[k:] - np.linalg.solve(own, matrix[k:, :k] @ (known - centre[:k]))
    root = np.linalg.inv(np.linalg.cholesky(own)).T
    first = StudentMixture(
        np.array([1 - FROM_PRIOR, FROM_PRIOR]), np.stack([middle, 0 * middle]), np.stack([WIDER * root, np.eye(n - k)])
    )
    draws = Importance(first, stream, inner, WIDER)
    for _ in range(ROUNDS):
        z = draws.draw()
        run = planned.run(np.hstack([np.tile(known, (inner, 1)), z]))
        draws.add(z, -planned.cost(values, run))
        if draws.effective >= FEWEST:
            break
    if not np.isfinite(draws.log):
        return -np.inf, 0.0
    return draws.log + 0.5 * (1 / draws.effective - 1 / len(draws.z)), draws.effective


def control_variate(d: Array, rows: Array, u: Array, asked: int) -> Array:
    """c (R,), see above, of innovations d (R, K') and sensitivities (R, K', n) at draws (R, n)."""
    others = rows[:, :, asked:]
    return 0.5 * (_centred(d, rows, u) - _centred(d, others, u[:, asked:]))


def _centred(d: Array, rows: Array, u: Array) -> Array:
    """q(S, d + S u), less what makes its mean depend on u more than in the mean over the draws."""
    inverse = np.linalg.inv(precision(rows))
    v = d + np.einsum("rki,ri->rk", rows, u)
    t = np.einsum("rki,rk->ri", rows, v)
    q = np.sum(v * v, axis=1) - np.einsum("ri,rij,rj->r", t, inverse, t)
    apart = inverse.mean(axis=0) - inverse  # A − Ā
    return np.asarray(q - np.einsum("ri,rij,rj->r", u, apart, u) + np.trace(apart, axis1=1, axis2=2))
