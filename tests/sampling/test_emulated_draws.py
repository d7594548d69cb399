"""Draws of a posterior that is a thin bent valley, whose moments and evidence one integral tells."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import ndtr, ndtri

from en4dvar import estimate
from en4dvar.data.noise import Predicted, noise_of
from en4dvar.data.observations import Observations
from en4dvar.descent.minima import Minimum
from en4dvar.ensemble.forecast import Forecast
from en4dvar.model.state import Parameter
from en4dvar.priors.prior import Prior, PriorTerm
from en4dvar.sampling import emulated_draws, modes
from en4dvar.sampling.emulated_draws import EmulatedProposal, RecordedRuns, log_ratio
from en4dvar.sampling.modes import HEATS, LAST_HEAT, TOO_FEW, sample_modes

N, WIDTH = 8, 0.03
BEND = np.array([0.6, -0.5, 0.4, 0.3])  # of the readings of z_1 to z_4


def bent(z0):
    """What z_0 adds to the readings; no polynomial."""
    return BEND * (np.cosh(0.9 * z0)[..., None] - 1)


class Valley:
    """y_k = z_k + bent_k(z_0) within 0.03 for k = 1 to 4, and z_5 to z_7 that no reading tells."""

    def __init__(self, lost=lambda z: np.zeros(len(z), dtype=bool)):
        self.prior = Prior(tuple(PriorTerm.normal(Parameter(f"z{i}", "1"), 0.0, 1.0) for i in range(N)))
        values = 0.7 * BEND + 0.1
        self.observations = Observations(np.arange(4) + 1.0, values, noise_of(np.full(4, WIDTH)), np.ones(4))
        self.lost, self.runs = lost, 0

    def run(self, z):
        self.runs += len(z)
        gone = self.lost(z)
        values = np.where(gone[:, None], np.nan, z[:, 1:5] + bent(z[:, 0]))
        return Forecast(Predicted(values), np.empty((len(z), 0)), tuple("lost" * int(g) for g in gone))

    def costs(self, z, outcome):
        observed = self.observations.cost(outcome.predicted)
        return np.where(outcome.active, 0.5 * np.sum(z**2, axis=1) + observed, np.inf)

    @property
    def recorded(self):
        return RecordedRuns(self.run, self)

    @property
    def about(self):
        """The Gaussian about a point of the valley, by the tangent there."""
        z0 = 0.5
        at = np.concatenate([[z0], self.observations.values - bent(z0), np.zeros(3)])
        slope = np.zeros((4, N))
        slope[:, 1:5], slope[:, 0] = np.eye(4), BEND * 0.9 * np.sinh(0.9 * z0)
        precision = np.eye(N) + slope.T @ slope / WIDTH**2
        return Minimum(at, np.linalg.inv(precision), float(0.5 * at @ at))

    @property
    def exact(self):
        """Quantiles 5, 50, 95 % of z_0, and the evidence without the constant of the readings' errors."""
        z0 = np.linspace(-6, 6, 48001)
        apart = self.observations.values - bent(z0)
        logs = -0.5 * z0**2 - 0.5 * np.sum(apart**2, axis=1) / (1 + WIDTH**2)
        logs += 2 * np.log(WIDTH**2 / (1 + WIDTH**2))  # four of √(s²/(1 + s²))
        density = np.exp(logs - logs.max())
        evidence = logs.max() + np.log(density.sum() * (z0[1] - z0[0]) / np.sqrt(2 * np.pi))
        return np.interp([0.05, 0.5, 0.95], np.cumsum(density) / density.sum(), z0), evidence


def weighted_quantiles(draws):
    z0, order = draws.x[:, 0], np.argsort(draws.x[:, 0])
    return np.interp([0.05, 0.5, 0.95], np.cumsum(draws.shares[order]), z0[order])


class Fading(Valley):
    """The same with z_0 = ln G and what vanishes with G: half of its posterior lies where G does hardly anything."""

    def __init__(self, width):
        super().__init__()
        self.width = width
        first = PriorTerm.lognormal(Parameter("G", "1"), 1.0, 2.0)
        self.prior = Prior((first, *self.prior.terms[1:]))
        self.observations = Observations(np.arange(4) + 1.0, 0.8 * BEND, noise_of(np.full(4, width)), np.ones(4))

    def run(self, z):
        values = z[:, 1:5] + BEND * np.exp(z[:, :1])
        return Forecast(Predicted(values), np.empty((len(z), 0)), ("",) * len(z))

    def costs(self, z, outcome):
        return 0.5 * np.sum(self.prior.white(z) ** 2, axis=1) + self.observations.cost(outcome.predicted)

    @property
    def about(self):
        """The Gaussian about G = 1, by the tangent there."""
        at = np.concatenate([[0.0], self.observations.values - BEND, np.zeros(3)])
        slope = np.zeros((4, N))
        slope[:, 1:5], slope[:, 0] = np.eye(4), BEND
        precision = np.diag(1 / np.square([2.0] + [1.0] * (N - 1))) + slope.T @ slope / self.width**2
        return Minimum(at, np.linalg.inv(precision), float(0.5 * at @ at))

    @property
    def exact(self):
        z0 = np.linspace(-12, 6, 48001)
        apart = self.observations.values - BEND * np.exp(z0)[:, None]
        density = np.exp(-(z0**2) / 8 - 0.5 * np.sum(apart**2, axis=1) / (1 + self.width**2))
        return np.interp([0.05, 0.5, 0.95], np.cumsum(density) / density.sum(), z0)


class Flipping(Valley):
    """The same J, of readings less what is predicted that change their signs all the time: no polynomial follows."""

    def __init__(self):
        super().__init__()
        self.aim = self.observations.values
        self.observations = Observations(np.arange(4) + 1.0, np.zeros(4), noise_of(np.full(4, WIDTH)), np.ones(4))

    def run(self, z):
        outcome = super().run(z)
        signs = np.sign(np.sin(1000 * z[:, :1]))
        return replace(outcome, predicted=Predicted(signs * (outcome.predicted.values - self.aim)))


def test_an_emulator_that_is_far_behind_the_mixture_is_given_up(monkeypatch):
    flipping, fitted = Flipping(), []
    made = EmulatedProposal.fitted

    def counted(*arguments):
        fitted.append(arguments[-1])
        return made(*arguments)

    monkeypatch.setattr(EmulatedProposal, "fitted", counted)
    monkeypatch.setattr(emulated_draws, "HIGHEST", 2)  # of higher ones, noise is no longer far behind
    draws = sample_modes(flipping.recorded, flipping.prior, [Valley().about], 1, 400.0)
    assert fitted == [*HEATS, LAST_HEAT]
    assert draws.effective > TOO_FEW


@pytest.mark.slow
@pytest.mark.parametrize("width", [WIDTH, 0.01])
def test_the_tail_of_what_vanishes_with_its_parameter_is_found(width):
    fading = Fading(width)
    several = [sample_modes(fading.recorded, fading.prior, [fading.about], seed, 400.0) for seed in range(4)]
    assert np.mean([weighted_quantiles(draws) for draws in several], axis=0) == pytest.approx(fading.exact, abs=0.25)


@pytest.mark.slow
def test_a_thin_bent_valley_is_sampled_to_its_tails_and_its_evidence_is_known():
    valley = Valley()
    expected, evidence = valley.exact
    several = [sample_modes(valley.recorded, valley.prior, [valley.about], seed, 400.0) for seed in range(3)]
    assert np.mean([weighted_quantiles(draws) for draws in several], axis=0) == pytest.approx(expected, abs=0.15)
    assert np.mean([draws.log_evidence for draws in several]) == pytest.approx(evidence, abs=0.1)
    assert min(draws.effective / len(draws.x) for draws in several) > 0.2
    # the same seeds without an emulator: a mixture keeps a small share of its draws
    mixed = [sample_modes(lambda z: valley.costs(z, valley.run(z)), valley.prior, [valley.about], seed, 400.0)
             for seed in range(3)]  # fmt: skip
    assert max(draws.effective / len(draws.x) for draws in mixed) < 0.15


def test_a_mixture_that_has_not_closed_in_judges_nothing():
    """a b t with a normal and b lognormal: most of the posterior is in a tail that gets thinner and thinner, of which
    the first two rounds tell by one draw. Given ln b, a is Gaussian; the rest is one sum.
    """
    t = np.linspace(0.1, 1.0, 10)
    y = -0.001 * np.array([17.3, -4.5, 45.1, 51.7, 46.5, 62.5, 65.4, 85.0, 109.0, 115.3])
    a, spread, median, width, rho, error = 1.06, 1.17, 1.5, 1.5, 0.49, 0.01
    prior = {"a": {"prior": "normal", "mean": a, "std": spread},
             "b": {"prior": "lognormal", "median": median, "log_std": width}}  # fmt: skip
    result = estimate(
        lambda p, t: p["a"] * p["b"] * t, (t, y), prior, error=error, seed=61, cheap=True, progress=False,
        prior_correlation=[{"between": ["a", "b"], "correlation": rho}],
    )  # fmt: skip
    z = np.linspace(-7, 7, 28001)
    slopes = median * np.exp(width * z)[:, None] * t / error
    apart = y / error - slopes * (a + rho * spread * z)[:, None]
    added = (1 - rho**2) * spread**2 * np.sum(slopes**2, axis=1)
    fitted = (1 - rho**2) * spread**2 * np.sum(slopes * apart, axis=1)
    logs = -0.5 * (z**2 + np.sum(apart**2, axis=1) - fitted * np.sum(slopes * apart, axis=1) / (1 + added))
    logs -= 0.5 * np.log1p(added)
    density = np.exp(logs - logs.max())
    evidence = np.log(density.sum() * (z[1] - z[0])) + logs.max() - 0.5 * np.log(2 * np.pi)
    of_errors = -len(t) * np.log(error * np.sqrt(2 * np.pi))
    assert result.dataset("sample_stats").attrs["log_evidence"] == pytest.approx(evidence + of_errors, abs=0.1)
    expected = np.interp([0.05, 0.5, 0.95], np.cumsum(density) / density.sum(), z)
    drawn = np.quantile(np.log(result.posterior["b"].values / median) / width, [0.05, 0.5, 0.95])
    assert drawn == pytest.approx(expected, abs=0.25)


T = np.linspace(0.1, 1.0, 10)
Y = -0.001 * np.array([3.33, 9.75, 9.67, 11.51, 15.31, 16.27, 20.85, 17.52, 22.85, 27.16])


def product(seed=0):
    """a b t with a normal and b half-normal, of which little is known but a b."""
    prior = {"a": {"prior": "normal", "mean": 0.81, "std": 1.01}, "b": {"prior": "half-normal", "std": 1.49}}
    return estimate(
        lambda p, t: p["a"] * p["b"] * t, (T, Y), prior, error=0.00162, seed=seed, cheap=True, progress=False,
        prior_correlation=[{"between": ["a", "b"], "correlation": 0.68}],
    )  # fmt: skip


@pytest.mark.slow
def test_draws_go_on_as_long_as_each_round_reaches_farther_along_a_valley():
    """The 5 % point of a is −1.5, by a sum over a grid; it was −1.02, −1.13 and −0.82."""
    z, other = np.linspace(-5, 5, 2001), np.linspace(-5, 5, 3001)[:, None]
    a, b = 0.81 + 1.01 * z, 1.49 * ndtri(0.5 + 0.5 * ndtr(other))
    misfit = (Y @ Y - 2 * a * b * (T @ Y) + (a * b) ** 2 * (T @ T)) / 0.00162**2
    logs = -0.5 * (misfit + (z**2 - 1.36 * z * other + other**2) / (1 - 0.68**2))
    density = np.sum(np.exp(logs - logs.max()), axis=0)
    exact = np.interp(0.05, np.cumsum(density) / density.sum(), a)
    ends = [np.quantile(product(seed).posterior["a"].values, 0.05) for seed in range(3)]
    assert np.mean(ends) == pytest.approx(exact, abs=0.3)


@pytest.mark.slow
def test_rounds_that_end_before_are_told(monkeypatch):
    assert "chain-not-converged" not in {c.code for c in product().cautions}
    monkeypatch.setattr(modes, "HEATS", HEATS[:1])  # after one round that trains, the next reaches farther
    monkeypatch.setattr(modes, "MOST_TRIED", 1)
    (told,) = (c for c in product().cautions if c.code == "chain-not-converged")
    assert "emulator" not in told.advice


def test_the_integral_of_a_density_beyond_the_draws_of_another_is_known():
    """3 N(0, 3²), beside 15 000 draws of N(0, 1): the logarithm of their mean weight alone is 0.14 to 0.20
    too low.
    """
    off = []
    for seed in range(6):
        random = np.random.default_rng(seed)
        draws = random.standard_normal(15000), 3 * random.standard_normal(600)
        off.append(log_ratio(*(0.5 * z**2 - z**2 / 18 for z in draws)) - np.log(3))
    assert off == pytest.approx(np.zeros(6), abs=0.1)


def test_the_integral_of_a_density_that_no_draw_of_another_reaches_ends():
    """Whole steps went to and fro for ever."""
    assert -30 < log_ratio(np.full(15000, -30.0), np.full(600, 30.0)) < 30


def test_where_the_model_cannot_be_run_nothing_is_drawn():
    valley = Valley(lost=lambda z: z[:, 0] > 0.3)
    draws = sample_modes(valley.recorded, valley.prior, [valley.about], 1, 400.0)
    assert draws.x[draws.shares > 0, 0].max() <= 0.3
    z0 = np.linspace(-6, 0.3, 48001)
    logs = -0.5 * z0**2 - 0.5 * np.sum((valley.observations.values - bent(z0)) ** 2, axis=1) / (1 + WIDTH**2)
    density = np.exp(logs - logs.max())
    expected = np.interp([0.05, 0.5, 0.95], np.cumsum(density) / density.sum(), z0)
    assert weighted_quantiles(draws) == pytest.approx(expected, abs=0.25)


def test_an_emulator_of_many_runs_bends_as_far_as_they_do():
    """J along the whole valley, by quadratic predictions, which are all that 200 runs allow, and by quartic ones."""
    valley, stream, off = Valley(), np.random.default_rng(3), []
    z = stream.standard_normal((3200, N))
    z[:, 0] = stream.uniform(-2.5, 2.5, len(z))
    z[:, 1:5] = valley.observations.values - bent(z[:, 0]) + WIDTH * z[:, 1:5]
    fresh, expected = z[3000:], valley.costs(z[3000:], valley.run(z[3000:]))
    for count in (200, 3000):
        recorded = valley.recorded
        recorded(z[:count])
        off.append(np.quantile(np.abs(recorded.emulated(8.0).cost(fresh) - expected), 0.9))
    assert off[0] > 0.3
    assert off[1] < 0.02


def test_a_draw_below_what_is_looked_for_ends_them_all():
    valley = Valley()
    draws = sample_modes(valley.recorded, valley.prior, [valley.about], 1, 400.0, below=1e9)
    assert valley.runs == 400
    assert draws.lowest < 1e9
