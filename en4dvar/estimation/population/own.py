r"""What each data set says by itself about the parameters of a population: draws of its own posterior, as a likelihood.

The draws follow p(y|x) π(x) with the data set's own prior π, weighted forward runs from its members and from the prior
(:mod:`en4dvar.sampling.modes`), so that all modes count by their weight and any kind of observation errors is taken as
it is: the scale of the errors and a discrepancy are further parameters of the data set. Where its posterior was sampled
by its own estimate, the draws are those that this has kept. Where an emulator of the predictions, fitted to all these
runs, says J of fresh ones, thousands of its draws are taken without a run: what scarce draws leave uncertain of each
likelihood makes the population of several data sets too narrow along a valley that all of them leave open.

Of the coordinates x that vary and the quantities θ that all data sets have in common (a density, a scale) the draws
tell how x follows θ (:mod:`~en4dvar.estimation.population.following`): the likelihood is one of y, such as x − Bθ,
which gives the regression of x on θ in the posterior the slopes (I − C) B, where C is the covariance of x given θ and
the prior of x is N(0, I). B may change along the likelihood: components of a mixture of x and θ tell it where they are.
A Gaussian mixture describes y; dividing by its prior leaves the likelihood of the data set, with which
:mod:`~en4dvar.estimation.population.hierarchy` works. No component is wider than the prior, so that each is one of the
likelihood. There are four, or eight of many draws: what too few get wrong is alike in all data sets and adds up, what
scarce draws get wrong averages out, and a criterion for fewer took upper limits for measurements. Where the population
lies in the tails of its data sets, where hardly a draw is, neither holds: then they are drawn with another prior, about
the population, which is divided out instead of their own. θ is known by its prior and by what the data
sets tell of it: where they tell a combination of density and scale, slopes hold only for what they leave of it. All
data sets of a population have the same slopes. Their own would tell of θ, and falsely: those of ln G are steeper for a
soft gel, and a θ that makes all of them stiffer would make them more alike.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.special import ndtri, stdtrit

from en4dvar.descent.minima import Minimum
from en4dvar.diagnosis.response.ledger import weighted_quantiles
from en4dvar.ensemble.forecast import Composite
from en4dvar.ensemble.linalg import effective_number, resampled, shares_of
from en4dvar.ensemble.missing import Beside
from en4dvar.estimation.population.following import Following, bent, following_of
from en4dvar.executor import Executor
from en4dvar.model.state import Array
from en4dvar.plumbing.compiled import kernel
from en4dvar.priors.prior import PriorTerm, member_stream, own_seed
from en4dvar.problem import InverseProblem
from en4dvar.sampling.emulated_cost import RIDGE, Coordinates, Emulator
from en4dvar.sampling.emulated_draws import EmulatedProposal, RecordedRuns
from en4dvar.sampling.mixture import StudentMixture, fit_gaussians
from en4dvar.sampling.modes import LAST_RUNS, sample_modes, typical_runs

ENOUGH = 500.0  # effective draws that are asked for: they know a mean to 4 % of its std
NARROWEST = 0.03  # standard deviation of the first draws about members, in units of the prior's
KEPT = 4000  # equally likely draws of each data set
HEAT, JUDGING = 1.5, 400  # of fresh draws of the emulated posterior, and the number of these, of which such a share
TRUSTED = 0.98  # must stay effective under J, for others of its draws to be taken without a run
PARTS, ROUNDS = 4, 200  # components of each mixture; rounds of expectation maximisation, of which four need more
MANY = 2500.0  # effective draws from which the components are twice as many
BESIDE = 1e-3  # prior standard deviations that runs for readings that one lacks are apart
SMALLEST = 1e-12  # variance that every slope is taken to have
INFORMED = 0.1  # least share of the prior's variance that the data take away, for a slope to be read from draws
RESAMPLED = 2000  # campaigns behind the interval of the median of data sets one by one
SILENT = 1e-3  # weight of a data set that tells nothing
DRAWN = 0.1  # of the prior's variance: what took less away is not freed of the prior any further
TAIL = 0.05  # beyond each end of that interval


class Mixture(NamedTuple):
    r"""L of one set as a mixture of Gaussians, and what it says about a population: ``precision`` Λ (M, n, n),
    ``linear`` η (M, n), ``constant`` k (M,). Kernels can read it.

    The draws of a posterior L_i(x) N(x; c_0, C_0) are described by a mixture Σ_m a_m N(c_m, Σ_m); the prior is divided
    out of every component, so that

        L_i(x) ∝ Σ_m exp(k_m + η_mᵀx − ½ xᵀΛ_m x),     Λ_m = Σ_m⁻¹ − C_0⁻¹,   η_m = Σ_m⁻¹ c_m − C_0⁻¹ c_0,
        ∫ L_i(x) N(x; ν, D) dx = Σ_m exp(k_m + ½ bᵀA⁻¹b − ½ νᵀD⁻¹ν) |I + DΛ_m|^{-1/2},  A = Λ_m + D⁻¹, b = η_m + D⁻¹ν,

    and x given ν, D is drawn exactly: a component, then N(A⁻¹b, A⁻¹). A direction the data say nothing about has Λ = 0;
    rounding below zero is cut off.
    """

    precision: Array
    linear: Array
    constant: Array

    @classmethod
    def divided(
        cls, mean: Array, covariance: Array, log_share: Array, prior_std: Array, prior_mean: Array | float = 0.0
    ) -> "Mixture":
        """Components of the posterior, means (M, n) and covariances (M, n, n), with the prior N(prior_mean, diag
        prior_std²) divided out. ``log_share`` (M,): ln of the components' shares.
        """
        # in units of the prior's standard deviation, so that cutting off means the same in every direction
        z, centre = mean / prior_std, prior_mean / prior_std
        values, vectors = np.linalg.eigh(covariance / np.outer(prior_std, prior_std))
        gain = np.maximum(1 / values - 1, 0.0)
        precision = np.einsum("sij,sj,skj->sik", vectors, gain, vectors)
        inverse = precision + np.eye(len(prior_std))
        linear = np.einsum("sij,sj->si", inverse, z)  # C⁻¹ z, with the same directions cut off
        log_det = -np.linalg.slogdet(inverse)[1]
        constant = log_share - 0.5 * (log_det + np.einsum("si,si->s", linear, z) - np.sum(centre**2))
        return cls(precision / np.outer(prior_std, prior_std), (linear - centre) / prior_std, constant)


@kernel
def condition(precision: Array, linear: Array, inverse: Array, pull: Array, middle: Array, root: Array) -> float:
    """A⁻¹b and the lower root of A = Λ + D⁻¹, b = η + D⁻¹ν; returns ½ bᵀA⁻¹b − ½ ln|A|, NaN where rounding leaves no
    root.
    """
    n = linear.size
    value = 0.0
    for i in range(n):
        for j in range(i + 1):
            total = precision[i, j] + inverse[i, j]
            for k in range(j):
                total -= root[i, k] * root[j, k]
            if i == j:
                if not total > 0.0:
                    return np.nan
                root[i, i] = np.sqrt(total)
                value -= np.log(root[i, i])
            else:
                root[i, j] = total / root[j, j]
        total = linear[i] + pull[i]
        for k in range(i):
            total -= root[i, k] * middle[k]
        middle[i] = total / root[i, i]
        value += 0.5 * middle[i] ** 2
    _back(root, middle)
    return value


@kernel
def _back(root: Array, z: Array) -> None:
    """z ← root⁻ᵀ z."""
    n = z.size
    for i in range(n - 1, -1, -1):
        total = z[i]
        for k in range(i + 1, n):
            total -= root[k, i] * z[k]
        z[i] = total / root[i, i]


@kernel
def draw_conditioned(middle: Array, root: Array, z: Array, out: Array) -> None:
    """A draw of N(middle, (root rootᵀ)⁻¹) from standard normal z, which is overwritten."""
    _back(root, z)
    for i in range(z.size):
        out[i] = middle[i] + z[i]


@kernel
def log_marginal(mixture: Mixture, mean: Array, inverse: Array) -> Array:
    """(B,) ln ∫ L(x) N(x; mean, inverse⁻¹) dx, for ``mean`` (B, n) and ``inverse`` (B, n, n). −∞ of an ``inverse`` that
    has no root by rounding: a walker far out among what is common tries such.
    """
    n_parts, n = mixture.linear.shape
    middle, root, logs, out = np.empty(n), np.zeros((n, n)), np.empty(n_parts), np.empty(mean.shape[0])
    nothing = np.zeros(n)
    for b in range(mean.shape[0]):
        pull = inverse[b] @ mean[b]
        own = condition(inverse[b], nothing, 0.0 * inverse[b], nothing, middle, root) + 0.5 * mean[b] @ pull
        for m in range(n_parts):
            part = condition(mixture.precision[m], mixture.linear[m], inverse[b], pull, middle, root)
            logs[m] = mixture.constant[m] + part if np.isfinite(part) else -np.inf
        top = logs.max()
        if not (np.isfinite(own) and np.isfinite(top)):
            out[b] = -np.inf
            continue
        out[b] = top + np.log(np.sum(np.exp(logs - top))) - own
    return out


@dataclass(frozen=True)
class OwnDraws:
    """Equally likely draws ``z`` (D, n) of one posterior, in white coordinates of its prior.

    ``log_evidence``: ln ∫ exp(−J_o) π dz; ``effective``: the number of independent draws that they are worth at least.
    ``about``: of the coordinates of a population, means and standard deviations (p,) under the prior that they were
    drawn with, 0 and 1 of π; ``gain``: ln of how many times its evidence is that of π.
    """

    z: Array
    log_evidence: float
    effective: float
    forward_runs: int
    about: tuple[Array | float, Array | float] = (0.0, 1.0)
    gain: float = 0.0

    @classmethod
    def kept(cls, problem: InverseProblem, draws: Array, effective: float, log_evidence: float) -> "OwnDraws":
        """What the estimate of a data set has kept: ``draws`` (D, n), physical, taken from others that are worth
        ``effective`` of them, and ln p(y). Raises :class:`ValueError` for a draw that the prior excludes.
        """
        z, log = problem.prior.white(problem.prior.from_physical(draws)), problem.observations.log_normalisation()
        return cls(z, log_evidence + log, _worth(len(draws), effective), 0)


@dataclass(frozen=True)
class OwnLikelihood:
    """The likelihood of one data set in p coordinates x given c common quantities θ, in units of its evidence.

    ``mixture``: of y, as ``following`` has it, the same in all; ``adjusted`` (D, p): the draws of y; ``half``: what
    the first half of them says alone.
    """

    mixture: Mixture
    half: Mixture
    following: Following
    adjusted: Array


def expected_runs(problem: InverseProblem) -> tuple[int, int]:
    """Most forward runs of :func:`own_draws`: where an emulator is good, and where few draws become effective."""
    return typical_runs(len(problem.prior.names), ENOUGH), math.ceil(LAST_RUNS * ENOUGH)


def own_draws(
    problem: InverseProblem, start: Array, seed: int, executor: Executor | None = None, enough: float = ENOUGH,
    emulate: bool = True,
) -> OwnDraws:  # fmt: skip
    """Draws of one posterior until ``enough`` are effective, from members (N, n) near it in white coordinates.

    The same for a data set whatever others there are. Raises :class:`ValueError` where no run succeeds.
    """
    prior, seed = problem.prior, own_seed(seed, problem.observations.name)
    composite = Beside(Composite(problem, executor), prior, BESIDE)
    x = prior.from_white(start)
    covariance = np.atleast_2d(np.cov(x, rowvar=False)) + np.diag((NARROWEST * prior.std) ** 2)
    about = Minimum(x.mean(axis=0), covariance, 0.0)  # of one alone, J does not matter
    runs = RecordedRuns(composite, problem)
    draws, stream = sample_modes(runs, prior, [about], seed, enough), member_stream(seed, "population: kept draws")
    z = prior.white(draws.x[resampled(draws.shares, KEPT, stream)])
    emulated = emulate and _emulated(runs, z, stream)
    if emulated:
        return OwnDraws(*emulated, composite.forward_runs)
    return OwnDraws(z, draws.log_evidence, _worth(KEPT, draws.effective), composite.forward_runs)


def _emulated(runs: RecordedRuns, z: Array, stream: np.random.Generator) -> tuple[Array, float, float] | None:
    """Draws, ln evidence and effective number as of :class:`OwnDraws`, of J emulated by all ``runs`` that led to draws
    ``z`` (D, n). None where fresh runs say that this is not J.

    What these say of Ĵ − J is a quadratic of z, by which the draws are weighed.
    """
    made = EmulatedProposal.fitted(runs, StudentMixture.fitted(z, stream, PARTS), stream, HEAT)
    if made is None:
        return None
    tried = made.draw(JUDGING, stream)
    apart = HEAT * made.cost(tried) - runs(runs.prior.from_white(tried))  # Ĵ − J, −∞ where a run fails
    cooled = (1 - HEAT) * made.cost(tried)
    of_emulated, shares = shares_of(cooled), shares_of(cooled + apart)
    share = 1 / float(np.sum(shares**2 / of_emulated))  # of draws of exp(−Ĵ) that stay effective under J
    if share < TRUSTED or not np.all(np.isfinite(apart)):
        return None
    count, n = len(tried), z.shape[1]
    left = Emulator.fitted(Coordinates.about(z), 2, tried, apart[:, None], shares, RIDGE)
    every = []
    for _ in range(KEPT // len(made.walkers)):
        made = made.settled(stream)
        every.append(made.walkers)
    free = np.concatenate(every)
    weights = shares_of((1 - HEAT) * made.cost(free) + left.predictions(free)[:, 0])
    evidence = float(np.logaddexp.reduce(cooled + apart)) - math.log(count) + made.log - 0.5 * n * math.log(2 * math.pi)
    worth = _worth(effective_number(weights), effective_number(shares) / max(1 - share, SMALLEST))
    return free[resampled(weights, KEPT, stream)], evidence, worth


def _worth(count: float, effective: float) -> float:
    """How many independent draws so many are worth that were taken from others, worth ``effective`` of them."""
    return 1 / (1 / effective + 1 / count)


def own_likelihoods(
    drawn: Sequence[OwnDraws], varying: Sequence[int], common: Sequence[int], seed: int, names: Sequence[str],
    logs: Array,
) -> list[OwnLikelihood]:  # fmt: skip
    """The likelihoods in the coordinates ``varying`` given those in ``common``; ``seed`` and the data sets' ``names``
    name the streams; ``logs`` (p,): the prior standard deviation of the logarithm of a positive parameter, else 0.
    """
    x, theta, following = _straight(drawn, varying, common, logs)
    if common:
        each = zip(x, theta, drawn, names, strict=True)
        parts = [_parts(z, t, of, member_stream(own_seed(seed, name), "population: slopes")) for z, t, of, name in each]
        following = bent(following, np.mean([z.mean(axis=0) for z in x], axis=0), parts)
    streams = (member_stream(own_seed(seed, name), "population: mixture") for name in names)
    likelihoods = []
    for z, t, draws, stream in zip(x, theta, drawn, streams, strict=True):
        y = following.own(z, t)
        whole, half = (_mixture(part, following, draws, stream) for part in (y, y[: len(y) // 2]))
        likelihoods.append(OwnLikelihood(whole, half, following, y))
    return likelihoods


def _straight(
    drawn: Sequence[OwnDraws], varying: Sequence[int], common: Sequence[int], logs: Array
) -> tuple[list[Array], list[Array], Following]:
    """Draws x (D, p) and θ (D, c) of each data set, and how x follows θ along straight lines."""
    x, theta = ([draws.z[:, list(columns)] for draws in drawn] for columns in (varying, common))

    def slopes(coordinates: Sequence[Array]) -> Array:
        each = zip(x, coordinates, theta, drawn, strict=True)
        of_sets = (_slopes(z, u, t, draws.effective, draws.about[1] * np.ones(len(varying))) for z, u, t, draws in each)
        return pooled_slopes(*zip(*of_sets, strict=True))

    return x, theta, following_of(x, theta, logs, slopes)


def in_units_of_the_common(
    drawn: Sequence[OwnDraws], varying: Sequence[int], common: Sequence[int], logs: Array
) -> tuple[list[OwnDraws], Array, Array]:
    """The draws with what is common in units of what is known of it, θ = mean + root ξ; ``mean`` (c,), ``root`` (c, c).

    Known are its prior and what the data sets tell. Draws of a posterior that are weighed so that the prior of x is
    one of y have the θ that their data tell, since the likelihood is one of y. Of a direction counts only by how much
    it is narrower than the narrowest of so few draws of the prior (Marchenko & Pastur 1967, Math. USSR Sb. 1, 457): by
    chance all data sets would tell a little, and it would add up.
    """
    every, shared, (x, theta, following) = list(drawn), list(common), _straight(drawn, varying, common, logs)
    precision, pull = np.eye(len(shared)), np.zeros(len(shared))
    for z, t, draws in zip(x, theta, every, strict=True):
        shares = shares_of(following.against(z, t, *draws.about))
        few = len(shared) * len(shares) / (effective_number(shares) * draws.effective)
        values, vectors = np.linalg.eigh((t - shares @ t).T @ (shares[:, None] * (t - shares @ t)))
        gain = max(1 - math.sqrt(few), 0.0) ** 2 / values
        precision += (vectors * np.maximum(gain - 1, 0.0)) @ vectors.T
        pull += (vectors * np.where(gain > 1, gain, 0.0)) @ vectors.T @ (shares @ t)
    mean, root = np.linalg.solve(precision, pull), np.linalg.cholesky(np.linalg.inv(precision))
    for i, draws in enumerate(every):
        moved = draws.z.copy()
        moved[:, shared] = np.linalg.solve(root, (theta[i] - mean).T).T
        every[i] = replace(draws, z=moved)
    return every, np.asarray(mean, dtype=float), np.asarray(root, dtype=float)


def _mixture(y: Array, following: Following, draws: OwnDraws, stream: np.random.Generator) -> Mixture:
    """Of y (D, p), some of the draws."""
    mean, std = (np.broadcast_to(part, y.shape[1]) for part in draws.about)
    std, beyond = following.prior(y, mean, std)
    constant = float(np.logaddexp.reduce(beyond)) - math.log(len(beyond)) + draws.gain
    alike = len(draws.z) / draws.effective  # of one draw: more make a bent valley fall too steeply beyond its draws
    if np.any(beyond):
        shares = shares_of(beyond)
        y = y[resampled(shares, len(shares), stream)]
        alike *= len(shares) / effective_number(shares)
    parts = PARTS if draws.effective < MANY else 2 * PARTS
    share, centre, covariance = fit_gaussians(y, stream, parts, ROUNDS, alike, std)
    return Mixture.divided(centre, covariance, np.log(share) + constant, std, mean)


def _parts(x: Array, theta: Array, draws: OwnDraws, stream: np.random.Generator) -> tuple[Array, Array, Array, Array]:
    """Of draws x (D, p) and θ (D, c), what :func:`~en4dvar.estimation.population.following.bent` asks for."""
    p, c = x.shape[1], theta.shape[1]
    std = np.append(np.broadcast_to(draws.about[1], p), np.ones(c))
    number = PARTS if draws.effective < MANY else 2 * PARTS
    both, alike = np.hstack([x, theta]), len(x) / draws.effective
    share, centre, covariance = fit_gaussians(both, stream, number, ROUNDS // 4, alike, std)
    precision = np.asarray(np.linalg.inv(covariance) - np.diag(1 / std**2), dtype=float)
    return share * draws.effective, centre[:, :p], precision[:, :p, :p], precision[:, :p, p:]


def _slopes(x: Array, u: Array, theta: Array, effective: float, std: Array) -> tuple[Array, Array]:
    """Slopes (p, c) with θ of the likelihood's coordinates ``u``, functions of x, from posterior draws x and u (D, p)
    and θ (D, c), and the variances (p, c) of these slopes. ``std`` (p,): of the prior of x.
    """
    if not theta.shape[1]:
        return np.zeros((x.shape[1], 0)), np.zeros((x.shape[1], 0))
    apart, centred = x - x.mean(axis=0), theta - theta.mean(axis=0)
    along = np.sum(apart * (u - u.mean(axis=0)), axis=0) / np.sum(apart**2, axis=0)  # du/dx, 1 of x itself
    apart = (u - u.mean(axis=0)) / along
    of_posterior = np.linalg.lstsq(centred, apart, rcond=None)[0].T
    left = np.atleast_2d(np.cov((apart - centred @ of_posterior.T).T))
    values, vectors = np.linalg.eigh(np.eye(len(left)) - left / np.outer(std, std))
    undone = std[:, None] * (vectors @ (vectors.T / np.maximum(values, INFORMED)[:, None])) / std
    variance = np.outer(np.diag(undone @ left @ undone.T), 1 / centred.var(axis=0)) / effective
    return np.asarray(along[:, None] * (undone @ of_posterior)), np.asarray(along[:, None] ** 2 * variance)


def pooled_slopes(slopes: Sequence[Array], variances: Sequence[Array]) -> Array:
    """(p, c): the mean of all (S, p, c), each counted by the inverse of its own error and of their scatter together
    (DerSimonian & Laird 1986, Control. Clin. Trials 7, 177). Slopes of a set with several modes are many times less
    certain than those of the others.
    """
    each, errors = np.array(slopes), np.maximum(np.array(variances), SMALLEST)
    weights = 1 / errors
    apart = each - np.sum(weights * each, axis=0) / weights.sum(axis=0)
    beyond = np.sum(weights * apart**2, axis=0) - (len(each) - 1)
    scatter = np.maximum(beyond, 0.0) / (weights.sum(axis=0) - np.sum(weights**2, axis=0) / weights.sum(axis=0))
    return np.asarray(np.average(each, axis=0, weights=1 / (scatter + errors)))


@dataclass(frozen=True)
class Empirical:
    """Physical 5, 50 and 95 % of the median over data sets: ``quantiles`` (3,) with all that is uncertain, and the
    parts of its half-width over 1.645 that come from between the data sets and from what they have in common.
    """

    quantiles: Array
    between: float
    common: float


def empirical(
    term: PriorTerm, middle: Array, std: Array, following: Following, seed: int, credible: Array | float = 1.0
) -> Empirical:
    """The median of data sets one by one, with its interval from their scatter: an answer that needs no model of them,
    of their medians and standard deviations (S,) in white coordinates; ``following``: of this coordinate alone.

    It stands beside that of the hierarchy as a check, and alone where there is no other. Each data set counts by the
    share of its prior's variance that its data took away, 1 − s², s the standard deviation of its own posterior without
    what all have in common: one that tells nothing has the prior's median. Where its own warnings say that readings are
    wrong it counts only as far as it is ``credible`` (S,), beside the others. Weights 1/s² would pull the median up,
    where the posterior of a logarithm is the wider the lower its value, as of soft gels. The interval is that of
    Student's t with the standard deviation of the weighted median under resampling of the data sets (Efron 1979, Ann.
    Stat. 7, 1), which is not taken to be smaller than the standard error of the weighted mean of data sets that agree.
    To this is added, in squares, how far the prior draws the median: each of many data sets that say little is drawn
    alike, and their scatter does not tell.
    """
    centre, spread = median_of(middle, std, member_stream(seed, f"empirical {term.parameter.name}"), credible)
    factor = float(stdtrit(len(middle) - 1, 1 - TAIL) / ndtri(1 - TAIL))

    def physical(own: float, common: float) -> Array:
        around = following.around(centre, own * factor * spread, common)
        return np.asarray(term.to_physical(term.mean + term.std * around))

    between, shared = (np.ptp(physical(*size)) / 2 for size in ((1.0, 0.0), (0.0, 1.0)))
    z = float(ndtri(1 - TAIL))
    return Empirical(physical(z, z), float(between), float(shared))


def median_of(
    middle: Array, std: Array, stream: np.random.Generator, credible: Array | float = 1.0
) -> tuple[float, float]:
    """The weighted median of data sets (S,), and its standard deviation."""
    learnt = np.maximum(1 - std**2, SILENT)
    weights = learnt * credible
    chosen = stream.integers(len(middle), size=(RESAMPLED, len(middle)))
    medians = np.array([_weighted_median(middle[of], weights[of]) for of in chosen])
    spread = max(float(medians.std()), float(np.linalg.norm(weights * std) / weights.sum()))
    centre = _weighted_median(middle, weights)
    drawn = _weighted_median(middle / np.maximum(learnt, DRAWN), weights) - centre  # a Gaussian's prior, divided out
    return centre, math.hypot(spread, drawn)


def _weighted_median(x: Array, weights: Array) -> float:
    return float(weighted_quantiles(x, weights / weights.sum(), (0.5,))[0])
