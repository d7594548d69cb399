"""Uniform, half-normal, beta and bounded priors against scipy's distributions and against quadrature."""

import math
from pathlib import Path

import numpy as np
import pytest
from scipy import stats
from scipy.integrate import quad
from scipy.special import log_ndtr, ndtr, ndtri, ndtri_exp
from toy_config import write_toy
from toys import OBSERVABLE, Vectorised, make_observations

from en4dvar.assembly.build import build
from en4dvar.config import load_config
from en4dvar.diagnosis.honesty.checks import at_bound
from en4dvar.estimation.assimilate import assimilate, log_posterior
from en4dvar.model.state import Parameter
from en4dvar.plumbing.errors import ConfigError
from en4dvar.priors import parameter_map
from en4dvar.priors.prior import Prior, PriorTerm
from en4dvar.problem import InverseProblem
from en4dvar.schemes.settings import AssimilationSettings

A = Parameter("a", "m")
CUT = PriorTerm.bounded(A, "normal", 1.0, 0.5, (0.0, 2.0))
NAMED = {
    "uniform": (PriorTerm.uniform(A, (-1.0, 3.0)), stats.uniform(-1, 4)),
    "half-normal": (PriorTerm.half_normal(A, 2.0, 0.5), stats.halfnorm(0.5, 2.0)),
    "half-normal from zero": (PriorTerm.half_normal(A, 2.0), stats.halfnorm(0, 2.0)),
    "beta": (PriorTerm.beta(A, (-1.0, 3.0), 2.0, 5.0), stats.beta(2, 5, -1, 4)),
    "bounded normal": (PriorTerm.bounded(A, "normal", 0.5, 1.0, (-1.5, 2.0)), stats.truncnorm(-2, 1.5, 0.5, 1.0)),
    "bounded at its mean": (PriorTerm.bounded(A, "normal", 1.0, 2.0, (1.0, 9.0)), stats.truncnorm(0, 4, 1.0, 2.0)),
    "normal cut below": (PriorTerm.bounded(A, "normal", 1.0, 1.0, (0.0, math.inf)), stats.truncnorm(-1, np.inf, 1.0)),
    "normal cut above": (
        PriorTerm.bounded(A, "normal", 1.0, 2.0, (-math.inf, 1.5)),
        stats.truncnorm(-np.inf, 0.25, 1, 2),
    ),
    "beta with peaks at its bounds": (PriorTerm.beta(A, (0.0, 1.0), 0.5, 0.5), stats.beta(0.5, 0.5)),
}


@pytest.mark.parametrize("name", NAMED)
def test_the_score_is_that_of_the_distribution(name):
    term, named = NAMED[name]
    x = np.linspace(-4, 4, 33)
    theta = term.to_physical(x)
    lower = x < 0
    assert named.cdf(theta[lower]) == pytest.approx(stats.norm.cdf(x[lower]), rel=1e-7)
    assert named.sf(theta[~lower]) == pytest.approx(stats.norm.sf(x[~lower]), rel=1e-7)
    assert np.all(np.diff(theta) > 0)
    assert term.from_physical(theta) == pytest.approx(x, abs=1e-7)


@pytest.mark.parametrize("name", NAMED)
def test_the_density_in_the_displayed_quantity(name):
    """N(x; 0, 1) dx = f(θ) dθ, with the slope that a varying parameter uses."""
    term, named = NAMED[name]
    for x in (-2.5, -0.3, 0.0, 1.7):
        density = math.exp(float(Prior((term,)).log_density(np.array([x])))) / term.slope(x)
        assert density == pytest.approx(float(named.pdf(float(term.to_physical(np.array(x))))), rel=1e-10)


@pytest.mark.parametrize("x", [-4.0, -2.5, 0.7, 4.0])
def test_the_slope_where_a_value_is_rounded_to_a_bound(x):
    """Of a beta with much of its probability there: that of 1 + θ/8 is an eighth of that of θ, which has its digits."""
    slopes = [PriorTerm.beta(A, bounds, 0.17, 1.2).slope(x) for bounds in ((0.0, 1.0), (1.0, 1.125))]
    step = 1e-5 * np.array([-1.0, 1.0])
    low, high = PriorTerm.beta(A, (0.0, 1.0), 0.17, 1.2).to_physical(x + step)
    assert slopes[0] == pytest.approx((high - low) / 2e-5, rel=1e-4)
    assert slopes[1] == pytest.approx(slopes[0] / 8, rel=1e-12)


@pytest.mark.parametrize("name", NAMED)
def test_moments_by_quadrature_and_of_draws(name):
    term, named = NAMED[name]
    for power in (1, 2):
        moment = quad(lambda x, p=power: float(term.to_physical(np.array(x))) ** p * stats.norm.pdf(x), -12, 12)[0]
        assert moment == pytest.approx(named.moment(power), rel=1e-7)
    drawn = Prior((term,)).to_physical(Prior((term,)).sample(4000, 1))[:, 0]
    assert drawn.mean() == pytest.approx(named.mean(), abs=4 * named.std() / math.sqrt(4000))
    assert stats.kstest(drawn, named.cdf).pvalue > 0.01


def test_a_kind_of_ones_own_needs_its_map_alone(monkeypatch):
    """As CONTRIBUTING says, here log-uniform between a and b, whose one number is ln b/a, and exponential."""
    own = parameter_map.QuantileMap(
        below=lambda x, shape: np.expm1(shape[0] * ndtr(x)) / math.expm1(shape[0]),
        above=lambda x, shape: np.expm1(-shape[0] * ndtr(-x)) / math.expm1(-shape[0]),
        score=lambda u, rest, shape: np.where(
            u * math.expm1(shape[0]) < math.expm1(shape[0] / 2),
            ndtri(np.log1p(u * math.expm1(shape[0])) / shape[0]),
            -ndtri(-np.log1p(rest * math.expm1(-shape[0])) / shape[0]),
        ),
        log_density=lambda u, rest, shape: -math.log(shape[0] * (u + 1 / math.expm1(shape[0]))),
    )
    without_end = parameter_map.QuantileMap(
        below=lambda x, shape: -log_ndtr(-x),
        above=lambda x, shape: -log_ndtr(-x),
        score=lambda u, rest, shape: np.where(u < 0.5, ndtri(-np.expm1(-u)), -ndtri_exp(-u)),
        log_density=lambda u, rest, shape: -u,
        upper=False,
    )
    for name, kind, bounds, shape, named in (
        ("log-uniform", own, (0.1, 10.0), (math.log(100),), stats.loguniform(0.1, 10.0)),
        ("exponential", without_end, (0.5, math.inf), (2.0,), stats.expon(0.5, 2.0)),
    ):
        monkeypatch.setitem(parameter_map.QUANTILE_MAPS, name, kind)
        monkeypatch.setitem(NAMED, name, (PriorTerm._by_quantiles(A, name, bounds, shape), named))
        test_the_score_is_that_of_the_distribution(name)
        test_the_density_in_the_displayed_quantity(name)
        test_moments_by_quadrature_and_of_draws(name)


def test_tails_keep_their_distance_to_the_bound():
    for term in (
        PriorTerm.uniform(A, (0.0, 2.0)),
        PriorTerm.half_normal(A, 1.0),
        PriorTerm.beta(A, (0.0, 2.0), 1, 1),
        CUT,
    ):
        far = float(term.to_physical(np.array(-20.0)))
        assert 0 < far < 1e-80
        assert float(term.from_physical(np.array(far))) == pytest.approx(-20, rel=1e-12)
    assert float(PriorTerm.half_normal(A, 1.0).to_physical(np.array(30.0))) == pytest.approx(30.02, abs=0.01)
    with pytest.raises(ValueError, match="strictly between 0 and 2"):
        PriorTerm.uniform(A, (0.0, 2.0)).from_physical(np.array(2.0))


def test_a_bounded_lognormal_is_the_exponential_of_a_bounded_normal():
    of_log = PriorTerm.bounded(A, "normal", math.log(2.0), 0.8, (math.log(0.5), math.log(30.0)))
    term = PriorTerm.bounded(A, "lognormal", 2.0, 0.8, (0.5, 30.0))
    x = np.linspace(-9, 9, 37)
    assert np.log(term.to_physical(x)) == pytest.approx(of_log.to_physical(x), rel=1e-9)
    assert term.from_physical(term.to_physical(x)[4:-4]) == pytest.approx(x[4:-4], rel=1e-6)
    for at in (-2.5, 0.0, 1.7):
        assert term.slope(at) == pytest.approx(float(term.to_physical(np.array(at))) * of_log.slope(at), rel=1e-9)


@pytest.mark.parametrize("log_std", [0.1, 0.7, 4.0])
def test_a_lognormal_that_is_cut_above_alone(log_std):
    """Of its logarithm; and small values do not pile up at a bound that nobody has set."""
    term = PriorTerm.bounded(A, "lognormal", 2.0, log_std, (0.0, 2.5))
    named = stats.truncnorm(-np.inf, math.log(2.5 / 2.0) / log_std, math.log(2.0), log_std)
    x = np.linspace(-6, 6, 25)
    theta = term.to_physical(x)
    assert named.cdf(np.log(theta[x < 0])) == pytest.approx(stats.norm.cdf(x[x < 0]), rel=1e-7)
    assert named.sf(np.log(theta[x >= 0])) == pytest.approx(stats.norm.sf(x[x >= 0]), rel=1e-7)
    assert term.from_physical(theta) == pytest.approx(x, abs=1e-6)
    prior = Prior((term,))
    members = prior.sample(200, 1)
    assert not list(at_bound(prior, members, 0.1 * members - 4, [""] * 200))
    (found,) = at_bound(prior, members, 0.1 * members + 5, [""] * 200)
    assert "pile up at its upper bound (2.5 m)" in found.words


@pytest.mark.parametrize("cut", ["upper: 4 N/m", "lower: 0 N/m, upper: 4 N/m"])
def test_a_cut_above_alone_from_yaml(tmp_path: Path, cut: str):
    (problem,) = build(load_config(write_toy(tmp_path, ("log_std: 0.3", f"log_std: 0.3, {cut}"))))
    (term,) = [term for term in problem.prior.terms if term.transform == "bounded-lognormal"]
    assert term.bounds == (pytest.approx(3 * math.exp(-2.7)), 4.0)


@pytest.mark.parametrize(
    ("cut", "bounds", "side"),
    [("lower: 2.5 N/m", (2.5, 12.0), "lower"), ("upper: 3.2 N/m", (-6.0, 3.2), "upper")],
)
def test_a_normal_that_is_cut_at_one_side_from_yaml(tmp_path: Path, cut: str, bounds: tuple[float, float], side: str):
    """The other bound is so far away that nothing piles up there."""
    (problem,) = build(
        load_config(
            write_toy(
                tmp_path,
                ("prior: lognormal, median: 3 N/m, log_std: 0.3", f"prior: normal, mean: 3 N/m, std: 0.3 N/m, {cut}"),
            )
        )
    )
    (term,) = [term for term in problem.prior.terms if term.transform == "bounded-normal"]
    assert term.bounds == pytest.approx(bounds)
    prior = Prior((term,))
    x = prior.sample(200, 1)
    (told,) = [*at_bound(prior, x, 0.1 * x - 5, [""] * 200), *at_bound(prior, x, 0.1 * x + 5, [""] * 200)]
    assert f"pile up at its {side} bound" in told.words


@pytest.mark.parametrize(
    ("kind", "mean", "std", "bounds", "words"),
    [
        ("normal", 5.0, 1.0, (0.0, 4.0), "5 does not lie between the bounds"),
        ("lognormal", 1.0, 1.0, (-1.0, 4.0), "the bounds of a logarithm must be positive"),
        ("normal", 0.0, 1e9, (-1.0, 1.0), "use a uniform prior"),
    ],
)
def test_bounds_that_do_not_suit_a_gaussian(kind, mean, std, bounds, words):
    with pytest.raises(ConfigError, match=words):
        PriorTerm.bounded(A, kind, mean, std, bounds)


@pytest.mark.parametrize(
    "name",
    ["uniform", *(pytest.param(name, marks=pytest.mark.slow) for name in ("half-normal", "beta", "bounded normal"))],
)
def test_posterior_and_evidence_of_a_linear_observation(name):
    """Sampled members, and exp(−J) summed over x, against quadrature over the parameter itself."""
    term, named = NAMED[name]
    times, std, y = np.array([0.5, 1.0, 1.5]), 1.1, np.array([0.9, -0.3, 0.2])
    observations = make_observations(times, y, std)
    problem = InverseProblem(Vectorised(("a",)), OBSERVABLE, observations, Prior((term,)))
    low, high = named.support()[0], min(named.support()[1], 20.0)

    def joint(theta):
        return named.pdf(theta) * np.prod(stats.norm.pdf(y, theta, std))

    evidence, first, second = (quad(lambda t, p=p: t**p * joint(t), low, high, limit=200)[0] for p in range(3))
    mean = first / evidence
    found = assimilate(problem, AssimilationSettings(members=400, refine="mcmc", draws=4000), 1)
    assert found.refinement["mcmc_converged"]
    spread = math.sqrt(second / evidence - mean**2)
    assert found.posterior[:, 0].mean() == pytest.approx(mean, abs=0.06 * spread)
    assert found.posterior[:, 0].std(ddof=1) == pytest.approx(spread, rel=0.05)
    x = np.linspace(-8, 8, 4001)
    log = log_posterior(problem, x[:, None]) - observations.log_normalisation() - 0.5 * math.log(2 * math.pi)
    assert math.log(np.sum(np.exp(log)) * (x[1] - x[0])) == pytest.approx(math.log(evidence), abs=1e-10)


def test_at_the_edge_of_a_uniform_prior():
    prior = Prior((PriorTerm.uniform(A, (0.0, 2.0)),))
    members = prior.sample(200, 1)
    (found,) = at_bound(prior, members, 0.1 * members + 3, [""] * 200)
    assert "of the posterior members of a pile up at its upper bound (2 m)" in found.line
    assert not list(at_bound(prior, members, members, [""] * 200))


def test_from_yaml_to_the_problem(tmp_path: Path):
    (problem,) = build(
        load_config(
            write_toy(
                tmp_path,
                ("A: {prior: normal, mean: maximum, std: 1 %}", "A: {prior: uniform, lower: 90 um, upper: 0.2 mm}"),
                ("prior: lognormal, median: 3 N/m, log_std: 0.3", "prior: half-normal, std: 3 N/m"),
                ("c: 0.02 N s/m", "c: {prior: beta, lower: 0 N s/m, upper: 0.1 N s/m, alpha: 2, beta: 5}"),
            )
        )
    )
    assert [t.transform for t in problem.prior.terms] == ["uniform", "half-normal", "beta"]
    assert [t.bounds for t in problem.prior.terms] == [pytest.approx((9e-5, 2e-4)), (0.0, math.inf), (0.0, 0.1)]
    assert [t.shape for t in problem.prior.terms] == [(), (3.0,), (2.0, 5.0)]


@pytest.mark.parametrize(
    ("prior", "fault"),
    [
        ("uniform, lower: 1 N/m", "a uniform prior takes lower and upper; given: lower"),
        ("uniform, lower: 2 N/m, upper: 1 N/m", "uniform needs finite bounds, low < high, not (2.0, 1.0)"),
        ("uniform, lower: -2 N/m, upper: 1 N/m", "-2 N/m is outside the bounds [0, inf] N/m"),
        ("half-normal, std: 10 %", "10 % is relative to the mean, which is zero; give it in N/m"),
        ("half-normal, median: 1 N/m", "a half-normal prior takes std, and lower where it does not start at zero"),
        ("beta, lower: 0 N/m, upper: 1 N/m, alpha: 2", "a beta prior takes lower, upper, alpha and beta"),
        ("beta, lower: 0 N/m, upper: 1 N/m, alpha: 2, beta: 0.01", "beta must lie between 0.1 and 1e+06, not 0.01"),
        ("beta, lower: 0 N/m, upper: 1 N/m, alpha: -2, beta: 1", "should be greater than 0, not -2"),
    ],
)
def test_bad_input_is_told_where_it_stands(tmp_path, prior, fault):
    with pytest.raises(ConfigError) as error:
        load_config(write_toy(tmp_path, ("lognormal, median: 3 N/m, log_std: 0.3", prior)))
    (told,) = error.value.problems
    assert fault in told.message
    assert told.line == 14
    assert told.column > 1
