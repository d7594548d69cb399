r"""Expected information by simulated readings, each of which is explained anew; and which of several laws holds.

Draw i of the prior predicts m_i and is read as y_i. With z = (a, b), a what is asked and b what else is unknown,

    g_i = ln p(y_i | a_i) − ln p(y_i),     p(y) = ∫ e^{−J_o} N(u; 0, I) du,     p(y | a) = ∫ e^{−J_o} N(b; 0, I) db,

both by importance sampling with runs of their own about the posterior of y_i (never with those of other draws, whose
number N would bound the result by ln N), and never with those that the proposal was fitted to, which make p(y) of a
bent posterior of six parameters a third too small. Of M draws of weight w the logarithm of their mean is too small by
var(w)/(2 M w̄²), which is added; what remains is O(M⁻²) (Rainforth et al. 2018, ICML, on nested estimates).

Were the prediction linear with the sensitivities S of draw i, g_i would be a constant and, with the whitened errors e,

    c_i = ½ q(S, e + S u) − ½ q(S_b, e + S_b b),     q(S, v) = vᵀ (I + SSᵀ)⁻¹ v.

With A = I − (I + SᵀS)⁻¹ the mean of q over e and u is that of the number of readings if the part uᵀ(A − Ā)u − tr(A − Ā)
is left out, Ā the mean over the draws; so is it of S_b. Such c has no expectation and is subtracted from g (a control
variate): the spread that is left is that of what is not linear.

The laws k = 1 … L are inverse problems of the same readings, equally probable before. Readings y are simulated from
draws of each, and the evidences of all laws found by importance sampling (:func:`log_integral`):

    P(k | y) = p(y | k) / Σ_j p(y | j),     I = ln L + E[ln P(k | y)] = ln L + E[Σ_j P(j | y) ln P(j | y)] ≤ ln L.

An error of the evidences makes the first form of the mutual information I of law and readings too small and the second
too large, by the same amount to second order; I is their mean. E[P(k | y)] of the law k that holds, which is linear in
P, is the probability that it will have: 1/L where readings tell nothing, 1 where they decide.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from en4dvar.ensemble.linalg import effective_number, shares_of
from en4dvar.estimation.design.planned import Gains, Planned, Tangents, about, precision, require_alive, standard_error
from en4dvar.model.state import Array
from en4dvar.priors.prior import member_stream, own_seed
from en4dvar.sampling.importance import ClosingDraws, FixedDraws, Importance
from en4dvar.sampling.mixture import StudentMixture

CLOSING = 3  # rounds at most in which proposals close in on a posterior
GOOD = 0.4  # effective share of the draws of a proposal that is close enough
ENOUGH, ROUNDS = 150.0, 15  # effective draws behind an integral, and rounds until then
THIN = 0.1  # share of integrals with fewer above which an estimate is rough
OTHERS, PLAUSIBLE = 6, 8.0  # draws that explain the readings best, and the J above the lowest that they may promise
FROM_PRIOR = 0.1  # share of a proposal that is the prior's: a second minimum is found, no weight is without bound
WIDER = 1.4  # than the Gaussian that it is made of, and than the posterior
DECIDED = 0.95  # probability of the law that holds: odds of 19, or a difference of 3 between two log-evidences


@dataclass(frozen=True)
class Nested(Gains):
    """Gains of simulated readings, less their control variate; ``linearised`` (R,) gains at the same draws,
    ``thin`` share of those with fewer effective draws than wanted. ``std`` (R, a) of what is asked in the posterior of
    each set of readings, in its units, ``relative`` (R, a) to the value that they are of, and ``ratio`` (R, a) to the
    prior's in transformed space.
    """

    linearised: Array
    thin: float
    std: Array
    relative: Array
    ratio: Array

    @property
    def correction(self) -> tuple[float, float]:
        """Difference of the gain from Laplace's estimate at the same draws, and the standard error of that."""
        difference = self.gains - self.linearised
        return float(difference.mean()), standard_error(difference)


def span_of_rounds(integrals: int, inner: int) -> tuple[int, int]:
    """The rounds of so many runs, of so many ``integrals`` of :func:`explained`, at least and as a rule at most: enough
    draws of a proposal half as good as is aimed at. A few hard integrals may take CLOSING + 3 ROUNDS each, never all.
    """
    return 2 * integrals, (CLOSING + min(math.ceil(2 * ENOUGH / (GOOD * inner)), 3 * ROUNDS)) * integrals


def nested(planned: Planned, u: Array, inner: int, seed: int, check: bool = False) -> Nested:
    """From draws (R, n) of the prior, one simulated set of readings and ``inner`` runs (a round) each.

    ``check``: an estimate that is rough is of no use, so that no further readings are explained once it is known to be
    one. The cost of an integral that many effective draws never stand behind is the highest.

    Raises :class:`TooFewMembersError` where the model mostly fails.
    """
    truths = planned.tangents(u)
    require_alive(len(truths.at), len(u))
    noise = planned.problem.observations.noise
    streams = [member_stream(seed, "design readings", int(i)) for i in truths.alive]
    values = np.stack([noise.drawn(draw.prediction, s) for draw, s in zip(truths.at, streams, strict=True)])
    plain, effective, spread = np.empty(len(values)), np.empty(len(values)), np.empty((len(values), 2, planned.asked))
    for i, (y, stream) in enumerate(zip(values, streams, strict=True)):
        near = explaining(planned, truths, y, i)
        asked = truths.u[i, : planned.asked]
        if len(asked) == len(planned.names):  # nothing else is unknown
            known, of_known = -float(planned.cost(y, planned.run(asked[None]))[0]), np.inf
        else:
            known, of_known = log_integral(explained(planned, y, asked, near, inner, stream))
        draws = explained(planned, y, truths.u[i, :0], near, inner, stream)
        log, of_all = log_integral(draws)
        plain[i], effective[i], spread[i] = known - log, min(of_known, of_all), _spread(planned, draws)
        if check and np.sum(effective[: i + 1] < ENOUGH) > THIN * len(values):
            count = i + 1
            truths, values = truths.some(range(count)), values[:count]
            plain, effective, spread = plain[:count], effective[:count], spread[:count]
            break
    alive = np.isfinite(plain)
    require_alive(int(alive.sum()), len(values))
    innovations, (_, rows) = truths.whitened(planned, values)[0], truths.whitened(planned)
    gains = plain - control_variate(innovations, rows, truths.u, planned.asked)
    linearised = 0.5 * np.linalg.slogdet(about(precision(rows), planned.asked))[1]
    order = planned.order[: planned.asked]
    true = planned.problem.prior.to_physical(planned.control(truths.u[alive]))[:, order]
    of_prior = np.linalg.norm(planned.root[order], axis=1)
    std, transformed = np.moveaxis(spread[alive], 1, 0)
    thin = float(np.mean(effective[alive] < ENOUGH))
    return Nested(gains[alive], linearised[alive], thin, std, std / np.abs(true), transformed / of_prior)


def _spread(planned: Planned, draws: Importance) -> Array:
    """Standard deviations (2, a) of what is asked, in its units and transformed, over weighted draws."""
    if not np.isfinite(draws.log):
        return np.full((2, planned.asked), np.nan)
    shares = draws.shares
    counts = shares > 0
    x, shares, asked = planned.control(draws.z[counts]), shares[counts], planned.order[: planned.asked]
    each = np.stack([values[:, asked] for values in (planned.problem.prior.to_physical(x), x)])
    squares = (each - np.einsum("d,qda->qa", shares, each)[:, None]) ** 2
    return np.asarray(np.sqrt(np.einsum("d,qda->qa", shares, squares) / max(1 - shares @ shares, 1e-9)))


def explaining(planned: Planned, truths: Tangents, values: Array, own: int | None) -> tuple[Array, Array]:
    """Gaussians where readings (K,) have a posterior: centres (M, n) and precisions (M, n, n).

    Each is one step of Gauss and Newton away from the draw that the readings are of, its ``own``, or from one that
    explains them.
    """
    observations = replace(planned.problem.observations, values=values)
    costs = [float(observations.cost(draw.prediction)) for draw in truths.at] + 0.5 * np.sum(truths.u**2, axis=1)
    chosen = list(dict.fromkeys([*([] if own is None else [own]), *np.argsort(costs)[:OTHERS].tolist()]))
    explained = truths.some(chosen)
    d, rows = explained.whitened(planned, np.tile(values, (len(explained.at), 1)))
    matrices = precision(rows)
    step = np.linalg.solve(matrices, (np.einsum("rki,rk->ri", rows, d) - explained.u)[..., None])[..., 0]
    lowest = np.array(costs)[chosen] - 0.5 * np.einsum("ri,rij,rj->r", step, matrices, step)
    plausible = lowest < lowest.min() + PLAUSIBLE
    plausible[0] = True
    return (explained.u + step)[plausible], matrices[plausible]


def log_integral(draws: Importance) -> tuple[float, float]:
    """ln ∫ e^{−J_o} N(·; 0, I) over the coordinates of :func:`explained`, and the effective draws behind it."""
    if not np.isfinite(draws.log):
        return -np.inf, 0.0
    return draws.log + 0.5 * (1 / draws.effective - 1 / len(draws.z)), draws.effective


def explained(
    planned: Planned, values: Array, known: Array, near: tuple[Array, Array], inner: int, stream: np.random.Generator
) -> Importance:
    """Draws of the coordinates behind the ``known`` ones, weighted by how they explain the readings.

    Proposals close in on the posterior in rounds of ``inner`` runs; draws of the last one are weighted, until enough
    of them are effective. One that would not come to that, as it was fitted to few, is closed in on again.
    """
    (centres, matrices), k = near, len(known)
    own = matrices[:, k:, k:]
    shift = np.linalg.solve(own, (matrices[:, k:, :k] @ (known - centres[:, :k])[..., None]))[..., 0]
    roots = WIDER * np.linalg.inv(np.linalg.cholesky(own)).transpose(0, 2, 1)

    def more(draws: Importance) -> None:
        z = draws.draw()
        draws.add(z, -planned.cost(values, planned.run(np.hstack([np.tile(known, (inner, 1)), z]))))

    alike = StudentMixture(np.full(len(own), 1 / len(own)), centres[:, k:] - shift, roots)
    closing = ClosingDraws(_beside_prior(alike), stream, inner, WIDER)
    for _ in range(CLOSING):
        more(closing)
        if closing.near or effective_number(shares_of(closing.tempered)) > GOOD * len(closing.z):
            break
    final = FixedDraws(_beside_prior(closing.next_proposal()), stream, inner)
    for _ in range(ROUNDS):
        more(final)
        if final.effective >= ENOUGH:
            break
        if final.effective * ROUNDS < ENOUGH * len(final.z) / inner:
            more(closing)
            final = FixedDraws(_beside_prior(closing.next_proposal()), stream, inner)
            more(final)
    return final


def _beside_prior(mixture: StudentMixture) -> StudentMixture:
    """With a share of draws from the prior's place and size."""
    n = mixture.centre.shape[1]
    return StudentMixture(
        np.append((1 - FROM_PRIOR) * mixture.share, FROM_PRIOR),
        np.vstack([mixture.centre, np.zeros(n)]),
        np.vstack([mixture.root, np.eye(n)[None]]),
    )


def control_variate(d: Array, rows: Array, u: Array, asked: int) -> Array:
    """c (R,), see above, of innovations d (R, K') and sensitivities (R, K', n) at draws (R, n)."""
    return 0.5 * (_centred(d, rows, u) - _centred(d, rows[:, :, asked:], u[:, asked:]))


def _centred(d: Array, rows: Array, u: Array) -> Array:
    """q(S, d + S u), less what makes its mean depend on u more than in the mean over the draws."""
    inverse = np.linalg.inv(precision(rows))
    v = d + np.einsum("rki,ri->rk", rows, u)
    t = np.einsum("rki,rk->ri", rows, v)
    q = np.sum(v * v, axis=1) - np.einsum("ri,rij,rj->r", t, inverse, t)
    apart = inverse.mean(axis=0) - inverse  # A − Ā
    return np.asarray(q - np.einsum("ri,rij,rj->r", u, apart, u) + np.trace(apart, axis1=1, axis2=2))


@dataclass(frozen=True)
class Decision:
    """Expected information of readings about which law holds, each number with its Monte Carlo standard error.

    ``information`` nats, of law and readings; ``probability`` that the law that holds will have; ``decided`` share of
    experiments in which that is 0.95 or more. ``thin`` share of the evidences with fewer effective draws than wanted.
    """

    information: float
    information_error: float
    probability: float
    probability_error: float
    decided: float
    decided_error: float
    thin: float

    @classmethod
    def of(cls, logs: Sequence[Array], thin: float = 0.0) -> "Decision":
        """From log-evidences (R, L) of readings simulated with each of the L laws, in their order."""
        told, holds = [], []
        for k, log in enumerate(logs):
            ln = log - np.logaddexp.reduce(log, axis=1, keepdims=True)
            entropy = -np.sum(np.exp(ln) * np.where(np.isfinite(ln), ln, 0.0), axis=1)
            told.append(np.log(len(logs)) + 0.5 * (ln[:, k] - entropy))
            holds.append(np.exp(ln[:, k]))
        decided, count = np.mean([np.mean(p >= DECIDED) for p in holds]), sum(map(len, holds))
        unsure = (decided * count + 2) / (count + 4)  # Agresti & Coull (1998): no share is known exactly
        return cls(
            *_mean(told), *_mean(holds), float(decided), float(np.sqrt(unsure * (1 - unsure) / (count + 4))), thin
        )


def _mean(values: Sequence[Array]) -> tuple[float, float]:
    """Mean over equally probable laws of the means of values (R,) of each, and its standard error."""
    errors = [standard_error(sample) for sample in values]
    return float(np.mean([sample.mean() for sample in values])), float(np.linalg.norm(errors) / len(values))


def deciding(laws: Sequence[Planned], count: int, inner: int, seed: int) -> Decision:
    """From ``count`` sets of readings of each law, and ``inner`` runs (a round) behind each evidence.

    ``laws`` share their observations, whose errors are those of the readings whichever law holds.

    Raises :class:`TooFewMembersError` where a model mostly fails.
    """
    tangents = [
        hypothesis.tangents(hypothesis.draws(count, own_seed(seed, f"law {k}"))) for k, hypothesis in enumerate(laws)
    ]
    for hypothesis in tangents:
        require_alive(len(hypothesis.at), count)
    noise, logs, behind = laws[0].problem.observations.noise, [], []
    for k, truths in enumerate(tangents):
        evidences = np.empty((len(truths.at), len(laws)))
        for i, number in enumerate(truths.alive):
            values = noise.drawn(truths.at[i].prediction, member_stream(seed, f"design readings {k}", int(number)))
            for j, law in enumerate(laws):
                near = explaining(law, tangents[j], values, i if j == k else None)
                stream = member_stream(seed, f"design evidence {k}", int(number))
                draws = explained(law, values, np.empty(0), near, inner, stream)
                evidences[i, j], effective = log_integral(draws)
                behind.append(effective)
        alive = np.isfinite(evidences[:, k])
        require_alive(int(alive.sum()), count)
        logs.append(evidences[alive])
    return Decision.of(logs, float(np.mean(np.array(behind) < ENOUGH)))
