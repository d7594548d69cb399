"""`linearisation: transform` ends where its own gradient vanishes: Lotka–Volterra, where J cannot tell."""

from __future__ import annotations

import numpy as np
import pytest

from en4dvar.data.noise import noise_of
from en4dvar.data.observations import Observations
from en4dvar.descent.step_control import LEAST, Settling
from en4dvar.diagnosis.analysis import Analysis
from en4dvar.estimation.assimilate import assimilate
from en4dvar.model.forward import Batch, ForwardModel, Observable, StateField
from en4dvar.model.state import Field, Parameter, StateLayout
from en4dvar.priors.prior import Prior, PriorTerm
from en4dvar.problem import InverseProblem
from en4dvar.schemes.settings import AssimilationSettings

RATES = {"growth": 1.1, "hunted": 0.4, "death": 0.4, "fed": 0.1}
START, MOST_STEP = (10.0, 5.0), 0.05


class Prey(ForwardModel):
    """Logarithms of prey and predators, by the classical Runge–Kutta method, all members at once."""

    observables = (Observable("prey", "1", StateField("prey")),)
    parameters = tuple(Parameter(name, "1", "lognormal", (0.0, np.inf)) for name in RATES)
    layout = StateLayout((Field("prey"), Field("predators"), Field("rates", 4)))
    compiled = True

    def initial_state(self, theta):
        return np.array([*START, *(theta[name] for name in RATES)])

    def trajectories(self, x, times):
        own = np.broadcast_to(times, (len(x), np.shape(times)[-1]))
        rates, u, now = x[:, 2:], np.log(x[:, :2]), 0.0
        states = np.empty((len(x), own.shape[1], 6))
        states[:, :, 2:] = rates[:, None]
        for k, then in enumerate(own[0]):
            u, now = self._after(u, rates, then - now), then
            states[:, k, :2] = np.exp(u)
        return Batch(own, states, self.layout)

    def step(self, x, t0, t1):
        return np.concatenate([np.exp(self._after(np.log(x[None, :2]), x[None, 2:], t1 - t0)[0]), x[2:]])

    def _after(self, u, rates, time):
        count = int(np.ceil(time / MOST_STEP))
        for _ in range(count):
            u = self._runge_kutta(u, rates, time / count)
        return u

    def _runge_kutta(self, u, rates, h):
        def slope(u):
            prey, predators = np.exp(u).T
            return np.stack([rates[:, 0] - rates[:, 1] * predators, rates[:, 3] * prey - rates[:, 2]], axis=1)

        a = slope(u)
        b = slope(u + h / 2 * a)
        c = slope(u + h / 2 * b)
        return u + h / 6 * (a + 2 * b + 2 * c + slope(u + h * c))


def prey_problem(seed: int, log_std: float = 0.4) -> InverseProblem:
    """25 counts of prey with errors of 1, rates known to 40 %."""
    model, times, random = Prey(), np.linspace(0.5, 12.0, 25), np.random.default_rng(seed)
    truth = np.array([*RATES.values()]) * np.exp(0.7 * log_std * random.standard_normal(4))
    (path,) = model.trajectories(np.array([[*START, *truth]]), times)
    values = path.states[:, 0] + random.standard_normal(len(times))
    terms = tuple(PriorTerm.lognormal(p, RATES[p.name], log_std) for p in model.parameters)
    observations = Observations(times, values, noise_of(np.ones(25)), np.ones(25), name="prey")
    return InverseProblem(model, model.observables[0], observations, Prior(terms))


def assert_by_definition(found: Analysis, spread: bool) -> None:
    """J where it ended, written out; where ``spread``, the members' is that of (I/s² + HᵀH)⁻¹, H by differences."""
    problem, last, step = found.problem, found.iterations[-1], 1e-4
    x, median, log_std = np.log(last.centre), np.log([*RATES.values()]), problem.prior.std
    beside = np.exp(x + step * np.vstack([np.zeros(4), np.eye(4), -np.eye(4)]))
    paths = problem.model.trajectories(np.array([[*START, *row] for row in beside]), problem.observations.times)
    at, ahead, behind = np.split(np.array([path.states[:, 0] for path in paths]), [1, 5])
    assert last.background == pytest.approx(0.5 * np.sum(((x - median) / log_std) ** 2), rel=1e-9)
    assert last.observation == pytest.approx(0.5 * np.sum((problem.observations.values - at[0]) ** 2), rel=1e-9)
    H = (ahead - behind) / (2 * step)
    std = np.sqrt(np.diag(np.linalg.inv(np.diag(log_std**-2.0) + H @ H.T)))
    assert not spread or np.log(found.posterior).std(axis=0, ddof=1) == pytest.approx(std, rel=0.05)


def compare(seed: int) -> tuple[float, float]:
    """How far the means of both linearisations are apart, and their spreads, in posterior standard deviations."""
    ends = []
    for linearisation in ("transform", "bundle"):
        settings = AssimilationSettings(linearisation=linearisation, refine="none", emulator="off")
        found = assimilate(prey_problem(seed), settings, seed)
        assert found.converged, found.stop_reason
        assert found.iterations[-1].step_norm <= settings.step_tolerance or linearisation == "bundle"
        assert_by_definition(found, spread=linearisation == "bundle")
        ends.append(np.log(found.posterior))
    std = ends[1].std(axis=0)
    apart = np.abs(ends[0].mean(axis=0) - ends[1].mean(axis=0)) / std
    return float(apart.max()), float(np.abs(ends[0].std(axis=0) / std - 1).max())


@pytest.mark.parametrize("seed", [4, 10])
def test_the_regression_converges_and_agrees_with_the_bundle(seed):
    apart, wider = compare(seed)
    assert apart < 0.25
    assert wider < 0.1


@pytest.mark.slow
def test_of_fifteen_seeds_every_one_converges():
    found = np.array([compare(seed) for seed in range(15)])
    assert np.median(found[:, 0]) < 0.15
    assert np.all(found < (0.6, 0.25))


def test_steps_that_shrink_are_taken_whole():
    settling = Settling()
    for norm in (0.4, 0.2, 0.09, 1e-3):
        settling = settling.after(norm)
    assert settling == Settling(1.0, 1e-3, held=False)


def test_steps_that_do_not_shrink_hold_the_transform_and_are_then_damped():
    settling = Settling().after(0.4).after(0.4)
    assert (settling.share, settling.held) == (1.0, True)
    assert settling.after(0.3).share == 0.5
    assert settling.after(0.3).after(0.22).share == 0.5
    for _ in range(10):
        settling = settling.after(1.0)
    assert settling.share == LEAST
