"""A model that gives its derivatives: the posterior in closed form, runs spared, wrong derivatives refused."""

from __future__ import annotations

import numpy as np
import pytest
from cut_anywhere import assert_cut_anywhere
from scipy.optimize import least_squares
from toys import Decay, make_problem

from en4dvar.data.noise import noise_of
from en4dvar.data.observations import Observations
from en4dvar.ensemble.forecast import Composite
from en4dvar.ensemble.tangent import Derivatives, check_derivatives
from en4dvar.estimation.assimilate import assimilate
from en4dvar.executor import ProcessesExecutor
from en4dvar.model.forward import Trajectory
from en4dvar.model.function_model import FunctionModel
from en4dvar.model.state import TIME_SHIFT, Parameter
from en4dvar.plumbing.errors import ConfigError
from en4dvar.priors.prior import Prior, PriorTerm
from en4dvar.problem import InverseProblem
from en4dvar.schemes.settings import AssimilationSettings

TIMES = np.linspace(0.1, 6.0, 60)
NAMES = [f"{kind}{i}" for i in range(5) for kind in "ak"]
TRUTH = {name: 1.0 + 0.2 * (i % 3) for i, name in enumerate(NAMES)}
MEDIAN, LOG_STD, STD = 1.2, 0.3, 0.02
TIGHT = {"step_tolerance": 1e-9, "cost_tolerance": 1e-15}


def decays(p, t):
    """Five decays, of an amplitude and a rate each."""
    return sum(p[f"a{i}"] * np.exp(-0.3 * (i + 1) * p[f"k{i}"] * t) for i in range(5))


def slopes(p, t):
    out = {}
    for i in range(5):
        out[f"a{i}"] = np.exp(-0.3 * (i + 1) * p[f"k{i}"] * t)
        out[f"k{i}"] = -0.3 * (i + 1) * t * p[f"a{i}"] * out[f"a{i}"]
    return out


def ten(jacobian=slopes, function=decays, extra=(), **more):
    """Ten lognormal parameters."""
    parameters = [Parameter(name, "1", bounds=(0, np.inf)) for name in NAMES]
    model = FunctionModel(function, parameters, {"y": "1"}, jacobian=jacobian, **more)
    values = decays(TRUTH, TIMES) + STD * np.random.default_rng(0).standard_normal(60)
    prior = Prior((*(PriorTerm.lognormal(p, MEDIAN, LOG_STD) for p in parameters), *extra))
    data = Observations(TIMES, values, noise_of(np.full(60, STD)), np.ones(60))
    return InverseProblem(model, model.observables[0], data, prior)


def estimate(problem, **settings):
    return assimilate(problem, AssimilationSettings(**settings), 1)


def test_the_posterior_is_that_of_the_closed_form():
    """The minimum of J by least squares with the derivatives written out, and the covariance (I + SᵀS)⁻¹ there."""
    problem = ten()
    y = problem.observations.values

    def physical(z):
        return dict(zip(NAMES, MEDIAN * np.exp(LOG_STD * z), strict=True))

    def jacobian(z):
        p = physical(z)
        return np.array([slopes(p, TIMES)[name] * p[name] * LOG_STD for name in NAMES]) / STD

    def residuals(z):
        return np.concatenate([(decays(physical(z), TIMES) - y) / STD, z])

    best = least_squares(
        residuals, np.zeros(10), lambda z: np.vstack([jacobian(z).T, np.eye(10)]), xtol=1e-15, ftol=1e-15
    )
    z = best.x
    assert np.linalg.norm(best.grad) < 1e-6
    covariance = np.linalg.inv(np.eye(10) + jacobian(z) @ jacobian(z).T)
    std = np.sqrt(np.diag(covariance))

    analysis = estimate(problem, **TIGHT)
    assert np.max(np.abs(np.log(analysis.centre / MEDIAN) / LOG_STD - z) / std) < 1e-6
    found = np.cov((np.log(analysis.posterior / MEDIAN) / LOG_STD).T)
    assert np.max(np.abs(found - covariance) / np.outer(std, std)) < 1e-6


class Counted:
    def __init__(self):
        self.runs = self.tangents = 0

    def function(self, p, t):
        self.runs += 1
        return decays(p, t)

    def jacobian(self, p, t):
        self.tangents += 1
        return slopes(p, t)


def test_half_the_runs_are_spared_and_all_are_counted():
    counted = Counted()
    by_tangent = estimate(ten(counted.jacobian, counted.function))
    by_runs = estimate(ten(counted.jacobian), linearisation="bundle")
    assert by_tangent.forward_runs == counted.runs
    around = 2 * 49 + 2  # prior and posterior, and the members that are run twice
    check = 10
    assert by_runs.forward_runs > 2 * by_tangent.forward_runs
    assert by_runs.forward_runs - around > 4 * (by_tangent.forward_runs - around - check)
    assert counted.tangents < 40
    mean, std = by_runs.posterior.mean(axis=0), by_runs.posterior.std(axis=0)
    assert np.max(np.abs(by_tangent.posterior.mean(axis=0) - mean) / std) < 0.01


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        (lambda p, t: {**slopes(p, t), "k1": 1.05 * slopes(p, t)["k1"]}, "by k1 are not those of its runs"),
        (lambda p, t: {**slopes(p, t), "a0": 0 * t, "k4": -slopes(p, t)["k4"]}, "by a0, k4 are not"),
        (lambda p, t: {"a0": t}, "derivatives fail where it runs: .*a3|derivatives fail where it runs: .*k0"),
        (lambda p, t: {**slopes(p, t), "a3": 1.0}, r"shape \(\) for y, expected \(60,\)"),
    ],
)
def test_wrong_derivatives_are_refused_once_by_name(wrong, words):
    with pytest.raises(ConfigError, match=words) as caught:
        estimate(ten(wrong))
    assert str(caught.value).count("derivatives") == 1
    assert str(caught.value).startswith("assimilation.linearisation")
    estimate(ten(wrong), linearisation="bundle", what_if=False)


def test_right_derivatives_of_a_path_that_bends_within_a_short_step_are_taken():
    """As over a long window of a chaotic model; a step of 1e-5 of the prior's width turns by one radian."""
    a = Parameter("a", "1")
    model = FunctionModel(
        lambda p, t: np.sin(1e5 * p["a"] + t), [a], {"y": "1"},
        jacobian=lambda p, t: {"a": 1e5 * np.cos(1e5 * p["a"] + t)},
    )  # fmt: skip
    data = Observations(TIMES, np.zeros(60), noise_of(np.ones(60)), np.ones(60))
    problem = InverseProblem(model, model.observables[0], data, Prior((PriorTerm.normal(a, 0.3, 1.0),)))
    composite, at = Composite(problem), np.array([0.3])
    check_derivatives(problem, Derivatives(problem), at, composite)


def test_a_tangent_is_asked_for_where_there_is_none():
    with pytest.raises(ConfigError, match="no tangent: the model gives no derivatives"):
        estimate(ten(None), linearisation="tangent")
    shifted = ten(extra=(PriorTerm.normal(TIME_SHIFT, 0.0, 0.01),))
    with pytest.raises(ConfigError, match="t_s is estimated"):
        estimate(shifted, linearisation="tangent")
    assert estimate(shifted).converged  # by runs


class Tangent(Decay):
    """The path, its rate and the parameters that the state carries."""

    def tangent(self, x, directions, times):
        a, b = x[2:]
        e = np.exp(-b * times)
        da, db = directions[:, 2, None], directions[:, 3, None]
        states = np.column_stack([[self.curve(x[2:], t), self.rate(x[2:], t), a, b] for t in times]).T
        y = da * e - db * a * times * e + 0.3 * db * times
        v = -da * b * e + db * a * (b * times - 1) * e + 0.3 * db
        rest = np.broadcast_to(directions[:, None, 2:], (len(directions), len(times), 2))
        return Trajectory(times, states, self.layout), np.concatenate([np.stack([y, v], -1), rest], -1)


@pytest.mark.parametrize("changes", [{}, {"time_std": 0.05}])
def test_a_model_of_states_with_a_rate(changes):
    """Against finite differences of its own runs, which are off by their size."""
    found = [
        assimilate(make_problem(kind(), (1.3, 0.7), **changes), AssimilationSettings(members=12, epsilon=1e-6), 3)
        for kind in (Tangent, Decay)
    ]
    assert found[0].forward_runs < found[1].forward_runs
    std = found[1].posterior.std(axis=0)
    assert np.max(np.abs(found[0].posterior - found[1].posterior) / std) < 1e-4


@pytest.mark.slow
def test_same_bits_in_processes_and_after_an_interruption():
    problem, settings = ten(), AssimilationSettings(what_if=False)
    whole = assert_cut_anywhere(problem, settings, 1, cuts=4)
    with ProcessesExecutor(2) as two:
        assert np.array_equal(assimilate(problem, settings, 1, two).posterior, whole.posterior)


class Shapes:
    """The decays of many members at once, and what shapes it was asked for."""

    def __init__(self):
        self.seen = set()

    def __call__(self, p, t):
        self.seen.add((p["a0"].shape, t.shape))
        return decays(p, t)


def test_a_function_of_many_members_always_takes_as_many():
    shapes = Shapes()
    found, one_by_one = estimate(ten(function=shapes, members=32, jacobian=None)), estimate(ten(None))
    assert shapes.seen == {((32, 1), (32, 60))}
    assert found.forward_runs == one_by_one.forward_runs
    std = one_by_one.posterior.std(axis=0)
    assert np.max(np.abs(found.posterior - one_by_one.posterior) / std) < 1e-7


def test_jax_on_the_processor():
    """Derivatives and batches by JAX, compiled once for one shape, against numpy."""
    jax = pytest.importorskip("jax")
    jax.config.update("jax_enable_x64", True)
    traced = []

    def function(p, t):
        traced.append(t.shape)
        return sum(p[f"a{i}"] * jax.numpy.exp(-0.3 * (i + 1) * p[f"k{i}"] * t) for i in range(5))

    by_jax = estimate(ten(jax.jit(jax.jacfwd(function)), jax.jit(function), members=16))
    by_hand = estimate(ten())
    assert sorted(traced) == [(16, 60), (60,)]
    assert by_jax.forward_runs == by_hand.forward_runs
    assert np.max(np.abs(by_jax.posterior - by_hand.posterior) / by_hand.posterior.std(axis=0)) < 1e-6
