"""The emulator of J, the walkers that sample it, and what a result says of its shape with their help."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from same_bits import assert_same_bits
from toys import Decay, Fragile, Toy, Vectorised, make_problem

from en4dvar.descent.weight_space import WeightSpace
from en4dvar.diagnosis.diagnostics import effective_share, is_non_gaussian
from en4dvar.diagnosis.honesty.checks import gaussian
from en4dvar.ensemble.forecast import forecast
from en4dvar.estimation.assimilate import assimilate, log_posterior
from en4dvar.executor import SerialExecutor, ThreadsExecutor
from en4dvar.model.state import NOISE_SCALE
from en4dvar.priors.prior import Prior, PriorTerm
from en4dvar.sampling import mcmc
from en4dvar.sampling.emulated_cost import emulate, needed_runs
from en4dvar.sampling.refine import CLEARED, guide
from en4dvar.sampling.walkers import advance
from en4dvar.schemes.settings import AssimilationSettings

LEVELS = {"plain": {}, "timing errors": {"time_std": 0.05}}


class Cubic(Toy):
    """Predictions that are cubic polynomials of the parameters, and their rates."""

    def curve(self, theta, t):
        a, b = theta
        return float(a * t + 0.3 * a * b * t**2 - 0.1 * b**3 + 0.2 * a * a * b)

    def rate(self, theta, t):
        a, b = theta
        return float(a + 0.6 * a * b * t)


def emulated(problem, seed=0, members=40):
    ensemble = problem.prior.mean + 0.3 * problem.prior.std * np.random.default_rng(seed).standard_normal(
        (members, len(problem.prior.names))
    )
    random = np.random.default_rng(seed)
    return emulate(lambda x: forecast(problem, x), problem, ensemble, random)


def assert_emulated(emulator, problem, x):
    """J below the ceiling, the ceiling beyond; some of ``x`` are on either side."""
    cost = -log_posterior(problem, x)
    z = (x - problem.prior.mean) / problem.prior.std
    of_prior = 0.5 * np.sum(z * z, axis=1)
    low = cost - of_prior < emulator.ceiling
    assert 10 < low.sum() < len(x) - 10
    assert emulator.cost(x)[low] == pytest.approx(cost[low], rel=1e-3, abs=1e-3)
    assert emulator.cost(x)[~low] == pytest.approx(of_prior[~low] + emulator.ceiling)


@pytest.mark.parametrize("level", LEVELS)
def test_emulator_of_cubic_predictions_is_j_itself(level):
    problem = make_problem(Cubic(), [0.8, 1.1], **LEVELS[level])
    emulator = emulated(problem)
    x = problem.prior.mean + problem.prior.std * np.random.default_rng(5).standard_normal((200, 2))
    assert_emulated(emulator, problem, np.concatenate([x, emulator.draws[::50]]))
    assert emulator.share > 0.999
    assert np.all(np.isfinite(emulator.draws))


def test_emulator_of_an_estimated_noise_scale():
    base = make_problem(Vectorised(("a", "b")), [1.0, 0.5], k=20)
    prior = replace(base.prior, terms=(*base.prior.terms, PriorTerm.lognormal(NOISE_SCALE, 1.0, 0.4)))
    problem = replace(base, prior=prior)
    emulator = emulated(problem)
    x = prior.mean + 0.3 * prior.std * np.random.default_rng(5).standard_normal((50, 3))
    assert_emulated(emulator, problem, np.concatenate([x, emulator.draws[::50]]))


def test_walkers_stay_where_data_narrow_a_lot():
    """Six parameters of a linear model; against the posterior in closed form. The prior has e^41 times its volume."""
    std, problem = 0.002, make_problem(Vectorised(tuple("abcdef")), [1.0, 0.5, 0.2, 0.9, 0.4, 0.7], std=0.002, k=40)
    prior, readings = problem.prior, problem.observations.values
    at = forecast(problem, np.vstack([prior.mean, prior.mean + np.eye(6)])).predictions
    H = (at[1:] - at[0]).T
    covariance = np.linalg.inv(np.diag(prior.std**-2) + H.T @ H / std**2)
    mean, stds = prior.mean + covariance @ H.T @ (readings - at[0]) / std**2, np.sqrt(np.diag(covariance))
    assert np.sum(np.log(prior.std)) - 0.5 * np.linalg.slogdet(covariance)[1] > 40
    random = np.random.default_rng(2)
    ensemble = mean + random.standard_normal((48, 6)) @ np.linalg.cholesky(covariance).T
    made = emulate(lambda x: forecast(problem, x), problem, ensemble, random)
    apart = (made.settled(np.random.default_rng(5)).draws - mean) / stds
    assert np.abs(apart).max() < 6
    assert apart.mean(axis=0) == pytest.approx(np.zeros(6), abs=0.15)
    assert apart.std(axis=0) == pytest.approx(np.ones(6), abs=0.1)


def test_no_emulator_of_many_parameters_or_few_survivors():
    assert needed_runs(5) == (3, 224)
    assert needed_runs(1) == (3, 96)
    assert needed_runs(12) == (2, 364)
    assert needed_runs(30) is None
    assert emulated(make_problem(Fragile(limit=5.0), [1.0, 0.5])) is not None
    assert emulated(make_problem(Fragile(limit=0.8), [1.0, 0.5])) is None  # half of the runs fail


def test_walkers_keep_a_distribution_they_start_from():
    """10 000 walkers drawn from N(m, C) move 30 times about fixed others and still have its moments."""
    rng = np.random.default_rng(1)
    mean, root = np.array([1.0, -2.0, 0.5]), np.array([[1.0, 0, 0], [0.9, 0.3, 0], [0.2, -0.4, 2.0]])
    inverse = np.linalg.inv(root)

    def cost(x):
        return 0.5 * np.sum(((x - mean) @ inverse.T) ** 2, axis=1)

    x = mean + rng.standard_normal((10_000, 3)) @ root.T
    others = mean + 1.5 * rng.standard_normal((200, 3)) @ root.T  # of another distribution: they only propose
    moved, costs = advance(cost, x, cost(x), others, rng, 30)
    assert np.mean(np.any(moved != x, axis=1)) > 0.95
    assert np.array_equal(costs, cost(moved))
    z = (moved - mean) @ inverse.T
    assert z.mean(axis=0) == pytest.approx(np.zeros(3), abs=0.04)
    assert np.cov(z.T) == pytest.approx(np.eye(3), abs=0.06)


def test_a_wrong_emulator_guides_to_the_right_density():
    """Twice as wide and beside the mark: the end points are accepted on the density itself."""
    start = np.random.default_rng(0).standard_normal((48, 2))
    chain = mcmc.sample(
        lambda x: -0.5 * np.sum(x**2, axis=1),
        start,
        4,
        target=1500,
        emulated=SimpleNamespace(cost=lambda x: 0.125 * np.sum((x - 0.7) ** 2, axis=1), draws=0.7 + 2 * start),
    )
    assert chain.converged
    assert chain.flat.mean(axis=0) == pytest.approx(np.zeros(2), abs=0.08)
    assert np.cov(chain.flat.T) == pytest.approx(np.eye(2), abs=0.1)


def skewed(compiled=True):
    model = Decay(compiled=compiled)
    a, b = model.parameters
    terms = (PriorTerm.lognormal(a, 1.2, 0.8), PriorTerm.lognormal(b, 1.0, 1.2))
    return make_problem(model, [1.5, 1.2], std=0.6, prior=terms, k=6)


@pytest.fixture
def nothing_cleared(monkeypatch):
    """An emulator for every posterior, also one that the members' own J do not call in question."""
    monkeypatch.setattr("en4dvar.sampling.refine.CLEARED", 1.0)


@pytest.mark.slow
def test_shift_and_ratio_are_those_of_the_posterior(nothing_cleared):
    """Against the posterior on a grid, in units of its standard deviation.

    The walk's own random error is 0.04 (shift) and 4 % (ratio) from seed to seed, so that the mean of twelve tells a
    systematic one of 0.05; no single run is off by five of them.
    """
    problem = skewed()
    axes = [m + s * np.linspace(-6, 6, 121) for m, s in zip(problem.prior.mean, problem.prior.std, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    p = np.exp(log_posterior(problem, grid))
    p /= p.sum()
    mean = p @ grid
    std = np.sqrt(p @ (grid - mean) ** 2)
    shifts, ratios = [], []
    for seed in range(12):
        analysis = assimilate(problem, AssimilationSettings(members=24, refine="none"), seed)
        x = problem.prior.from_physical(analysis.posterior)
        ratio = x.std(axis=0, ddof=1) / std
        shape = analysis.shape
        shifts.append(shape["mean_shift"] - np.max(np.abs(x.mean(axis=0) - mean) / std))
        ratios.append(np.log(shape["spread_ratio"] / ratio[np.argmax(np.abs(np.log(ratio)))]))
        assert shape["emulator_fit"] > 0.8
    for errors in (shifts, ratios):
        assert abs(np.mean(errors)) < 0.05
        assert np.max(np.abs(errors)) < 0.2


def test_the_emulator_is_for_cheap_models_unless_asked_for(nothing_cleared):
    settings = AssimilationSettings(members=24, refine="none")
    slow, fast = skewed(compiled=False), skewed()
    runs = 2 * needed_runs(2)[1]
    without, with_ = assimilate(slow, settings, 1), assimilate(fast, settings, 1)
    assert "mean_shift" not in without.shape
    assert with_.forward_runs == without.forward_runs + runs
    assert assimilate(slow, replace(settings, emulator="on"), 1).shape == with_.shape
    assert "mean_shift" not in assimilate(fast, replace(settings, emulator="off"), 1).shape


def test_a_gaussian_posterior_costs_no_more_runs_than_it_has_members():
    problem = make_problem(Vectorised(("a", "b"), compiled=True), [1.0, 0.5])
    analysis = assimilate(problem, AssimilationSettings(), 1)
    tails = {"tail_shift", "tail_ratio", "tail_excess", "tail_members", "tail_elsewhere"}
    assert set(analysis.shape) == {"gaussian_fit", "non_gaussian"} | tails
    assert not analysis.shape["tail_elsewhere"]
    assert not analysis.shape["non_gaussian"]
    assert analysis.shape["tail_ratio"] == pytest.approx(1, abs=1e-6)
    assert analysis.forward_runs == assimilate(problem, AssimilationSettings(refine="none"), 1).forward_runs + 48


class Kinked(Toy):
    """y = a + g t with g = b above zero and b/5 below."""

    def curve(self, theta, t):
        return float(theta[0] + self.rate(theta, t) * t)

    def rate(self, theta, t):
        return float(max(theta[1], 0.2 * theta[1]))


def test_a_tail_beyond_a_kink_that_no_member_has_reached():
    """Against the posterior on a grid: two standard deviations from the mode J rises a fifth as steeply."""
    problem = make_problem(Kinked(("a", "b"), compiled=True), [1.0, 0.15], std=0.15, seed=3)
    prior, observations = problem.prior, problem.observations
    axes = [m + s * np.linspace(-6, 6, 801) for m, s in zip(prior.mean, prior.std, strict=True)]
    a, b = (axis.ravel() for axis in np.meshgrid(*axes))
    residuals = [
        y - a - np.where(b > 0, b, b / 5) * t for t, y in zip(observations.times, observations.values, strict=True)
    ]
    z = np.stack([(x - m) / s for x, m, s in zip((a, b), prior.mean, prior.std, strict=True)])
    J = 0.5 * np.sum(np.square(residuals), axis=0) / 0.15**2 + 0.5 * np.sum(z**2, axis=0)
    p = np.exp(J.min() - J)
    mean, std = np.average(b, weights=p), np.sqrt(np.cov(b, aweights=p))
    for refine, right in (("none", False), ("auto", True)):
        found = assimilate(problem, AssimilationSettings(refine=refine), 1)
        members = prior.from_physical(found.posterior)[:, 1]
        assert (abs(members.std(ddof=1) / std - 1) < 0.1) == right
        assert (abs(members.mean() - mean) < 0.1 * std) == right
        assert refine == "auto" or found.shape["gaussian_fit"] > CLEARED


def test_shape_has_the_same_bits_for_any_workers():
    one = assimilate(skewed(), AssimilationSettings(members=24), 1)
    with ThreadsExecutor(2) as executor:
        assert_same_bits(assimilate(skewed(), AssimilationSettings(members=24), 1, executor), one)


@pytest.mark.parametrize(
    ("shift", "ratio", "share", "flag"),
    [(0.6, 1.0, 0.9, True), (0.1, 1.4, 0.9, True), (0.1, 0.6, 0.9, True), (0.3, 1.1, 0.9, False), (9, 9, 0.1, False)],
)
def test_the_flag_follows_the_emulator_where_it_can_be_believed(shift, ratio, share, flag):
    shape = {"gaussian_fit": 0.6, "mean_shift": shift, "spread_ratio": ratio, "emulator_fit": share}
    assert is_non_gaussian(shape) is flag
    assert bool([*gaussian(Prior(()), np.empty((2, 0)), shape)]) is flag
    assert is_non_gaussian({**shape, "gaussian_fit": 0.2}) is (flag or share < 0.2)


def test_effective_share():
    assert effective_share(np.zeros(50)) == 1
    assert effective_share(np.where(np.arange(50) < 20, 3.0, -np.inf)) == pytest.approx(0.4)
    one_in_a_tail = np.zeros(100)
    one_in_a_tail[7] = 50.0
    assert effective_share(one_in_a_tail) == 1  # it does not decide


class Valley(Toy):
    """b follows a² within a narrow valley: quadratic, so that the emulator is exact."""

    def curve(self, theta, t):
        a, b = theta
        return float(0.3 * a if t < 1.0 else 5 * (b - a * a))

    def rate(self, theta, t):
        return 0.0


def valley():
    model = Valley()
    prior = tuple(PriorTerm.normal(p, 0.0, 1.0) for p in model.parameters)
    return make_problem(model, [0.5, 0.25], std=0.2, k=8, prior=prior)


def moments_of_the_valley(problem):
    axis = np.linspace(-3, 3, 601)
    grid = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)
    a, b = grid.T
    y, early = problem.observations.values, problem.observations.times < 1
    residuals = [*(v - 0.3 * a for v in y[early]), *(v - 5 * (b - a * a) for v in y[~early])]
    cost = 0.5 * (a * a + b * b) + 0.5 * sum(r * r for r in residuals) / 0.2**2
    weights = np.exp(cost.min() - cost)
    weights /= weights.sum()
    mean = weights @ grid
    return mean, np.sqrt(weights @ (grid - mean) ** 2)


def test_a_doubt_is_told_by_walkers_that_have_settled():
    """A hundred moves from a Gaussian into a bent valley are too few: spreads were a fifth too small."""
    problem = valley()
    settings = AssimilationSettings(members=24, emulator="on", refine="none", starts=1)
    analysis = assimilate(problem, settings, 1)
    space = WeightSpace(problem, settings, 1, SerialExecutor())
    mean, std = moments_of_the_valley(problem)
    hasty = guide(space, analysis.posterior, 1, fits=2)
    off = np.abs(np.log(hasty.draws.std(axis=0) / std)).max()
    assert off > 0.2
    # what is told is of those that walked on
    told = np.array([analysis.shape[f"emulated_std_{name}"] for name in "ab"])
    assert np.abs(np.log(told / std)).max() < 0.6 * off
    settled = hasty.settled(np.random.default_rng(1))
    assert np.abs(np.log(settled.draws.std(axis=0) / std)).max() < 0.6 * off
    assert np.abs((settled.draws.mean(axis=0) - mean) / std).max() < 0.1
