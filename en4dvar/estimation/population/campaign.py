r"""The population of a campaign's data sets, whatever their law, start, errors and priors.

All quantities are in white coordinates of each data set's own prior (:meth:`~en4dvar.priors.prior.Prior.white`):
hyperpriors then have no unit, ν ~ N(prior mean, (``mean_std`` prior std)²) and τ ~ half-normal(``spread``
prior std), and what is a data set's own (a radius, a time shift, the scale of its errors) may have a prior of its own
in each. Each data set is sampled by itself (:mod:`~en4dvar.estimation.population.own`), and what its draws say of the
population enters the hierarchy (:mod:`~en4dvar.estimation.population.hierarchy`) as a likelihood.
"""

import itertools
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace

import numpy as np
import scipy  # its trees where they are used: a twentieth of what every command imports

from en4dvar.data.observations import require_distinct
from en4dvar.ensemble.forecast import check_problem
from en4dvar.ensemble.linalg import effective_number, resampled, shares_of
from en4dvar.estimation.population.following import Following
from en4dvar.estimation.population.hierarchy import Effort, Hierarchy, HierarchyDraws, HyperPrior, named
from en4dvar.estimation.population.own import (
    ENOUGH,
    Empirical,
    OwnDraws,
    OwnLikelihood,
    empirical,
    in_units_of_the_common,
    own_draws,
    own_likelihoods,
)
from en4dvar.executor import Executor, one_blas_thread
from en4dvar.model.state import Array
from en4dvar.plumbing.errors import ConfigError
from en4dvar.plumbing.hints import suggest
from en4dvar.priors.prior import PriorTerm, member_stream, own_seed
from en4dvar.problem import AT_ONCE, InverseProblem, common_to

DETERMINED = 0.9  # of the hyperprior's variance, taken away by the data
IN_IT = 0.2  # of the largest exponent: a parameter that is part of a combination
HALF_NORMAL_VARIANCE = 1 - 2 / np.pi
COINCIDE = (
    "its draws coincide, so that nothing tells how far its parameters may be off; the errors stated of its readings "
    "may be far too small, or these readings wrong"
)
FEWEST_SETS = 3  # with fewer nothing is known of a spread
FEWEST = 100.0  # effective draws of a result that can be trusted
REACH = 1.5  # prior standard deviations: a hyperprior of mean and spread that reaches further needs draws that do
NODES = 24  # of the quadrature
NEAR = 5  # draws of a data set among which one is chosen for what is its own
SCARCE = 0.25  # variance of ln p(all data | mean and spread) by the draws of the data sets, from which more are taken
ANEW, BEYOND, BELONGS = 3, 1.5, 0.5  # times, twice as many each; how much more widely than it lies; of such sets


@dataclass(frozen=True)
class Draws:
    """Physical draws (M, p) of the population's median and mean, of the standard deviation between data sets, and of
    the next one; in units of the prior ``nu`` and ``tau``. The median of a lognormal population is its geometric mean.
    """

    median: Array
    mean: Array
    between: Array
    next: Array
    nu: Array
    tau: Array


@dataclass(frozen=True)
class Population:
    """The population of ``names`` in ``problems``: ``posterior`` and ``prior`` draws; ``sets`` (M, S, n) physical, each
    data set given all of them.

    ``effective``: numbers of independent draws that stand behind the hierarchy and, together, behind the data sets;
    ``log_evidence``: of all data, hyperpriors included, without Σ ln(std √2π); ``forward_runs`` that were made.
    ``common``: names of the quantities with one value in all data sets, ``theta`` (M, c) their draws in units of the
    prior. ``belongs`` (S,): probability that each data set is of the population, ``odd_before``: that it is not, before
    its data are seen. ``empirical``: for each of ``names`` the median of the data sets one by one. ``left_out``: data
    sets that could not be sampled, and why.
    ``uncertain``: variance that the scarcity of the data sets' draws leaves of ln p(all data | mean and spread).
    """

    names: tuple[str, ...]
    problems: tuple[InverseProblem, ...]
    hyper: HyperPrior
    posterior: Draws
    prior: Draws
    sets: Array
    effective: tuple[float, float]
    log_evidence: float
    forward_runs: int
    common: tuple[str, ...] = ()
    theta: Array = field(default_factory=lambda: np.empty((0, 0)))
    belongs: Array = field(default_factory=lambda: np.empty(0))
    odd_before: Array = field(default_factory=lambda: np.empty(0))
    empirical: tuple[Empirical, ...] = ()
    left_out: Mapping[str, str] = field(default_factory=dict)
    uncertain: float = 0.0

    @property
    def size(self) -> float:
        """Number of independent draws behind the result: the variances that both leave add up."""
        return 1 / (1 / self.effective[0] + 1 / self.effective[1])

    @property
    def converged(self) -> bool:
        """True if the result can be trusted: at least 100 effective draws."""
        return self.size >= FEWEST

    @property
    def terms(self) -> tuple[PriorTerm, ...]:
        """Priors of ``names``, the same in all data sets."""
        return terms_of(self.problems, self.names)

    @property
    def odd(self) -> tuple[int, ...]:
        """Numbers of the data sets that are named as odd."""
        return named(self.belongs, self.odd_before)

    @property
    def learned(self) -> tuple[Array, Array]:
        """(p,) each: what share of the hyperprior's variance of ν and of τ the data have taken away."""
        nu, tau = self.posterior.nu, self.posterior.tau
        return (
            1 - nu.var(axis=0) / self.hyper.mean_std**2,
            1 - tau.var(axis=0) / (HALF_NORMAL_VARIANCE * self.hyper.spread**2),
        )

    @property
    def parts(self) -> tuple[Array, Array]:
        """(p,) each: the standard deviation of the population's median that is left where the common quantities are
        known, and what these add, by regression of the draws.
        """
        apart, theta = self.posterior.median - self.posterior.median.mean(axis=0), self.theta
        if not theta.shape[1]:
            return apart.std(axis=0), np.zeros(apart.shape[1])
        centred = theta - theta.mean(axis=0)
        told = centred @ np.linalg.lstsq(centred, apart, rcond=None)[0]
        return (apart - told).std(axis=0), told.std(axis=0)

    def without_hyperprior(self, seed: int) -> tuple[Draws, float]:
        """Draws as they are where ν and τ are equally likely everywhere, and how many of them count.

        From the posterior's draws, weighed; fewer than :data:`FEWEST` say that the hyperprior decides.
        """
        d, h = self.posterior, self.hyper
        shares = shares_of(0.5 * np.sum((d.nu / h.mean_std) ** 2 + (d.tau / h.spread) ** 2, axis=1))
        taken = resampled(shares, len(shares), member_stream(seed, "without hyperprior"))
        kept = Draws(*(getattr(d, field.name)[taken] for field in fields(Draws)))
        return kept, effective_number(shares) / len(shares) * self.size

    def combinations(self) -> "tuple[Combination, ...]":
        """Combinations of the means that the data determine where they do not determine each mean by itself."""
        if np.all(self.learned[0] >= DETERMINED):
            return ()
        values, vectors = np.linalg.eigh(np.atleast_2d(np.cov(self.posterior.nu.T)) / self.hyper.mean_std**2)
        scales = np.array([term.std for term in self.terms])
        combinations = []
        for value, vector in zip(values, vectors.T, strict=True):
            slopes = vector / scales  # Σ v_j z_j = Σ (v_j / s_j) x_j + …
            slopes = slopes / slopes[np.argmax(np.abs(vector))]
            kept = np.abs(vector) > IN_IT * np.abs(vector).max()
            if 1 - value >= DETERMINED and kept.sum() > 1:
                std = float((self.posterior.nu[:, kept] * scales[kept] @ slopes[kept]).std())
                parts = tuple((self.names[j], float(slopes[j])) for j in np.flatnonzero(kept))
                combinations.append(Combination(parts, std))
        return tuple(combinations)


@dataclass(frozen=True)
class Combination:
    """Σ a_j x_j of transformed population means, known to ``std``: of lognormal ones a product Π θ_j^{a_j}."""

    parts: tuple[tuple[str, float], ...]
    std: float


def terms_of(problems: Sequence[InverseProblem], names: Sequence[str]) -> tuple[PriorTerm, ...]:
    """Priors of ``names``. Raises :class:`ConfigError`: not estimated in all problems, or with other priors."""
    shared_terms = []
    for name in names:
        for problem in problems:
            if name not in problem.prior.names:
                words = f"{name}: not estimated in {problem.observations.name}{suggest(name, problem.prior.names)}"
                raise ConfigError(words)
        terms = [p.prior.terms[p.prior.names.index(name)] for p in problems]
        if any(term != terms[0] for term in terms):
            raise ConfigError(f"{name}: its prior must be the same in all data sets of a population: {AT_ONCE}")
        shared_terms.append(terms[0])
    return tuple(shared_terms)


def require_population(problems: Sequence[InverseProblem], names: Sequence[str]) -> None:
    """Raises :class:`ConfigError`, see :func:`population_of`."""
    if len(set(names)) < len(names):
        raise ConfigError(f"population of {', '.join(names)}: name each parameter once")
    terms_of(problems, names)
    for name, what in itertools.product(names, (of.name for of in fields(Draws))):
        if (taken := f"{name}_{what}") in problems[0].constant.prior.names:  # a variable of its file
            raise ConfigError(f"{taken}: the {what} of the population of {name} has this name, too; call one otherwise")
    for problem in problems:
        name = problem.observations.name
        check_problem(problem)
        if problem.constant.prior.names != problems[0].constant.prior.names:
            raise ConfigError(f"{name}: a population needs the same parameters in all data sets: {AT_ONCE}")
        if problem.walks or problem.fields:
            raise ConfigError(f"{name}: a population needs parameters that do not vary in time or space")
        if correlated := [n for block in problem.prior.blocks for n in block.names if n in names]:
            raise ConfigError(f"{name}: {correlated[0]}: a population needs a prior that is not correlated")


def population_of(
    problems: Sequence[InverseProblem],
    start: Sequence[Array],
    names: Sequence[str],
    seed: int,
    *,
    kept: Sequence[OwnDraws | None] = (),
    executor: Executor | None = None,
    hyper: HyperPrior | None = None,
    effort: Effort | None = None,
    tell: Callable[[str], None] = lambda words: None,
    doubted: Collection[str] = (),
) -> Population:
    """The population of ``names`` behind data sets of the same parameters.

    Parameters
    ----------
    start: of each data set control vectors (N_i, n) near its posterior, in white coordinates of its prior.
    kept: of each data set draws of its posterior, None where there are none; it is then sampled.
    hyper: in units of the prior's standard deviations. One that is much wider than the prior reaches where draws of
        the posterior do not: data sets are then sampled anew, with a prior as wide.
    tell: called with a line about each data set.
    doubted: names of data sets that are odd with probability :data:`~en4dvar.estimation.population.hierarchy.DOUBTED`.

    Raises
    ------
    ConfigError: fewer than 3 data sets, or two of one name, which random numbers belong to; readings that would count
        twice; other parameters in one than in another, or such as vary in time; a prior of ``names`` that is
        correlated, or not the same in all. ValueError: fewer than 3 data sets have successful runs.
    """
    if len(problems) < FEWEST_SETS:
        raise ConfigError(f"a population needs at least {FEWEST_SETS} data sets")
    require_population(problems, names)
    called = [problem.observations.name for problem in problems]
    if twice := sorted({name for name in called if called.count(name) > 1}):
        raise ConfigError(f"data sets of a population need different names: {', '.join(twice)} twice")
    require_distinct([problem.observations for problem in problems])
    hyper, effort = hyper or HyperPrior(), effort or Effort()
    if (factor := math.hypot(hyper.mean_std, hyper.spread)) > REACH:
        tell(f"data sets are sampled with a prior {factor:.2g} times as wide, which is what the hyperprior allows")
        around = np.zeros(len(names)), np.full(len(names), factor)
        wide = [_about(problem, names, *around) for problem in problems]
        at = [w.prior.white(p.prior.from_white(z)) for w, p, z in zip(wide, problems, start, strict=True)]
        scaled = replace(hyper, mean_std=hyper.mean_std / factor, spread=hyper.spread / factor)
        result = population_of(
            wide, at, names, seed, executor=executor, hyper=scaled, effort=effort, tell=tell, doubted=doubted
        )
        sampled = tuple(p for p in problems if p.observations.name not in result.left_out)
        posterior, prior = (
            replace(draws, nu=factor * draws.nu, tau=factor * draws.tau) for draws in (result.posterior, result.prior)
        )
        return replace(result, problems=sampled, hyper=hyper, posterior=posterior, prior=prior)
    with one_blas_thread():
        drawn, left_out = sampled_sets(problems, start, seed, executor, tell, kept)
        result = population_from(drawn, left_out, start, problems, names, seed, hyper, effort, doubted)
        for number in range(ANEW):
            if result.uncertain < SCARCE:
                break
            tell("data sets have too few draws where their population is: more are taken there")
            near = _distribution(result)
            for s, belongs in zip(drawn, result.belongs.tolist(), strict=True):
                if belongs > BELONGS:
                    again, enough = own_seed(seed, f"sampled anew, {number}"), ENOUGH * 2**number
                    drawn[s] = _drawn_about(problems[s], names, near, start[s], drawn[s], again, executor, enough)
            anew = population_from(drawn, left_out, start, problems, names, seed, hyper, effort, doubted)
            result = replace(anew, empirical=result.empirical)  # of the data sets' own posteriors
        return result


def _distribution(population: Population) -> tuple[Array, Array]:
    """Mean and standard deviation (p,) of the next data set, in units of the prior, the latter widened."""
    nu, tau = population.posterior.nu, population.posterior.tau
    return nu.mean(axis=0), BEYOND * np.sqrt(nu.var(axis=0) + np.mean(tau**2, axis=0))


def _drawn_about(
    problem: InverseProblem, names: Sequence[str], about: tuple[Array, Array], start: Array, before: OwnDraws,
    seed: int, executor: Executor | None, enough: float,
) -> OwnDraws:  # fmt: skip
    """Draws with a prior of ``names`` that is ``about`` their population; those ``before`` where no run succeeds."""
    near, own = _about(problem, names, *about), problem.prior
    try:
        draws = own_draws(near, near.prior.white(own.from_white(start)), seed, executor, enough, emulate=False)
    except ValueError:
        return before
    z, runs = own.white(near.prior.from_white(draws.z)), before.forward_runs + draws.forward_runs
    gain = draws.log_evidence - before.log_evidence
    return OwnDraws(z, before.log_evidence, draws.effective, runs, about, gain)


def _about(problem: InverseProblem, names: Sequence[str], mean: Array, std: Array) -> InverseProblem:
    """With a prior of ``names`` about ``mean`` (p,), ``std`` (p,) times as wide, in units of its own."""
    moves = dict(zip(names, zip(mean.tolist(), std.tolist(), strict=True), strict=True))
    each = ((term, *moves.get(term.parameter.name, (0.0, 1.0))) for term in problem.prior.terms)
    terms = (replace(term, mean=term.mean + m * term.std, std=s * term.std) for term, m, s in each)
    return replace(problem, prior=problem.prior.of(tuple(terms)))


def sampled_sets(
    problems: Sequence[InverseProblem], start: Sequence[Array], seed: int, executor: Executor | None,
    tell: Callable[[str], None], kept: Sequence[OwnDraws | None] = (),
) -> tuple[dict[int, OwnDraws], dict[str, str]]:  # fmt: skip
    """Draws of each data set by its number, those that are ``kept`` or its own, and why others have none."""
    drawn: dict[int, OwnDraws] = {}
    left_out: dict[str, str] = {}
    each = zip(problems, start, kept or [None] * len(problems), strict=True)
    for s, (problem, members, own) in enumerate(each):
        name = problem.observations.name
        try:
            drawn[s] = own or own_draws(problem, members, seed, executor)
        except ValueError as error:  # a kind of which is LinAlgError, of a matrix nobody else knows
            left_out[name] = COINCIDE if isinstance(error, np.linalg.LinAlgError) else str(error)
            tell(f"{name}: left out, {left_out[name]}")
        else:
            tell(f"{name}: {drawn[s].forward_runs} forward runs, {drawn[s].effective:.0f} effective draws")
    if len(drawn) < FEWEST_SETS:
        told = "; ".join(f"{name}: {reason}" for name, reason in [*left_out.items()][:1])
        raise ValueError(f"only {len(drawn)} of {len(problems)} data sets can be sampled; {told}")
    return drawn, left_out


def population_from(
    drawn: Mapping[int, OwnDraws], left_out: Mapping[str, str], start: Sequence[Array],
    campaign: Sequence[InverseProblem], names: Sequence[str], seed: int, scales: HyperPrior, effort: Effort,
    doubted: Collection[str] = (),
) -> Population:  # fmt: skip
    """The population of the data sets that could be sampled."""
    problems = tuple(campaign[s] for s in drawn)
    terms, columns = terms_of(problems, names), problems[0].constant.prior.names  # changes stand behind them
    common = common_to(problems, names)
    varying, shared = [columns.index(name) for name in names], [columns.index(name) for name in common]
    sets = [problem.observations.name for problem in problems]
    logs = np.array([term.log_std for term in terms])
    draws, mean, root = in_units_of_the_common(list(drawn.values()), varying, shared, logs)
    likelihoods = own_likelihoods(draws, varying, shared, seed, sets, logs)
    before = scales.odd_before([name in doubted for name in sets])
    estimated = Hierarchy(likelihoods, scales, before).sampled(seed, effort)
    theta, stream = mean + estimated.theta @ root.T, member_stream(seed, "hyperprior")
    nu, tau = stream.standard_normal(estimated.nu.shape), np.abs(stream.standard_normal(estimated.nu.shape))
    z = _sets(estimated, draws, likelihoods, varying, shared, member_stream(seed, "sets given all"))
    for own in z:
        own[:, shared] = theta
    sets_of = ((entry.prior, own) for entry, own in zip(problems, z, strict=True))
    physical = [prior.to_physical(prior.from_white(own))[:, : len(columns)] for prior, own in sets_of]
    return Population(
        names=tuple(names),
        problems=problems,
        hyper=scales,
        posterior=_draws(terms, estimated.nu, estimated.tau, member_stream(seed, "next")),
        prior=_draws(terms, scales.mean_std * nu, scales.spread * tau, stream),
        sets=np.stack(physical, axis=1),
        effective=(estimated.effective, float(sum(draws.effective for draws in drawn.values()))),
        log_evidence=estimated.log_evidence + sum(draws.log_evidence for draws in drawn.values()),
        forward_runs=sum(draws.forward_runs for draws in drawn.values()),
        common=common,
        theta=theta,
        belongs=estimated.belongs,
        odd_before=before,
        empirical=_empirical(terms, [start[s][:, varying] for s in drawn], likelihoods, seed, before),
        uncertain=float(estimated.uncertain.sum()),
        left_out=left_out,
    )


def _empirical(
    terms: Sequence[PriorTerm], members: Sequence[Array], likelihoods: Sequence[OwnLikelihood], seed: int, before: Array
) -> tuple[Empirical, ...]:
    """The median over data sets of each parameter, from members (N_i, p) of each, which are odd with the probability
    ``before`` (S,): by what is known of them alone, for the check must not depend on the hierarchy."""
    credible = (1 - before) / (1 - before.min())
    middle = np.array([np.median(z, axis=0) for z in members])
    std = np.array([likelihood.adjusted.std(axis=0) for likelihood in likelihoods])  # without what all have in common
    slopes, logs = likelihoods[0].following.slopes, likelihoods[0].following.logs
    each = (Following(slopes[j : j + 1], logs[j : j + 1]) for j in range(len(terms)))
    pairs = zip(terms, middle.T, std.T, each, strict=True)
    return tuple(empirical(term, m, s, following, seed, credible) for term, m, s, following in pairs)


def _sets(
    estimated: HierarchyDraws, drawn: Sequence[OwnDraws], likelihoods: Sequence[OwnLikelihood], varying: Sequence[int],
    shared: Sequence[int], stream: np.random.Generator,
) -> list[Array]:  # fmt: skip
    """Control vectors (M, n) of each data set given all, white: what is neither of the population nor common is as
    in one of the data set's own draws whose y is nearest, moved with what is common as its draws have it.
    """
    z = []
    for s, (draws, likelihood) in enumerate(zip(drawn, likelihoods, strict=True)):
        scale = likelihood.adjusted.std(axis=0)
        _, near = scipy.spatial.cKDTree(likelihood.adjusted / scale).query(estimated.x[:, s] / scale, k=NEAR)
        chosen = near[np.arange(len(near)), stream.integers(NEAR, size=len(near))]
        own, theta = draws.z[chosen], draws.z[:, list(shared)]
        rest = np.setdiff1d(np.arange(own.shape[1]), [*varying, *shared])
        apart = draws.z[:, rest] - draws.z[:, rest].mean(axis=0)
        slopes = np.linalg.lstsq(theta - theta.mean(axis=0), apart, rcond=None)[0]
        own[:, rest] += (estimated.theta - theta[chosen]) @ slopes
        own[:, list(varying)] = likelihood.following.together(estimated.x[:, s], estimated.theta)
        z.append(own)
    return z


def moments(terms: Sequence[PriorTerm], nu: Array, tau: Array) -> tuple[Array, Array]:
    """Physical mean and standard deviation (M, p) of parameters whose coordinates are N(ν, τ²), (M, p) each.

    In closed form for normal and lognormal ones, else by Gauss–Hermite quadrature.
    """
    mean, std = nu.copy(), tau.copy()
    nodes, weights = np.polynomial.hermite_e.hermegauss(NODES)
    weights = weights / weights.sum()
    for j, term in enumerate(terms):
        if term.transform == "lognormal":
            mean[:, j] = np.exp(nu[:, j] + tau[:, j] ** 2 / 2)
            std[:, j] = mean[:, j] * np.sqrt(np.expm1(tau[:, j] ** 2))
        elif term.transform != "normal":
            values = term.to_physical(nu[:, j, None] + tau[:, j, None] * nodes)
            mean[:, j] = values @ weights
            std[:, j] = np.sqrt((values - mean[:, j, None]) ** 2 @ weights)
    return mean, std


def _draws(terms: Sequence[PriorTerm], nu: Array, tau: Array, stream: np.random.Generator) -> Draws:
    """Physical draws of white ν and τ (M, p)."""
    mean, std = np.array([term.mean for term in terms]), np.array([term.std for term in terms])
    centre = mean + std * nu
    x = centre + std * tau * stream.standard_normal(nu.shape)
    median, following = (
        np.stack([term.to_physical(of[:, j]) for j, term in enumerate(terms)], axis=1) for of in (centre, x)
    )
    return Draws(median, *moments(terms, centre, std * tau), following, nu, tau)
