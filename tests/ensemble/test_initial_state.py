"""Perturbations of the initial state in the control vector: any model, and against the closed-form smoother."""

from dataclasses import replace

import numpy as np
import pytest
from toy_models import Oscillator, OscillatorSettings
from toys import make_observations

from en4dvar.config.varies import perturbation
from en4dvar.ensemble.forecast import check_problem
from en4dvar.estimation.assimilate import assimilate, forecast
from en4dvar.plumbing.errors import ConfigError
from en4dvar.priors.prior import Prior
from en4dvar.problem import InverseProblem
from en4dvar.schemes.settings import AssimilationSettings

FIXED = {"A": 1.0, "k": 2.0, "c": 0.3}
TIMES = np.linspace(0.2, 5.0, 12)
STD = 0.05


def oscillator(*perturbed, values=None):
    model = Oscillator(OscillatorSettings())
    fields = {f.name: f for f in model.layout}
    pairs = [perturbation(fields[name], std) for name, std in perturbed]
    observations = make_observations(TIMES, np.zeros(12) if values is None else values, STD)
    prior, acting = Prior(tuple(term for term, _ in pairs)), tuple(p for _, p in pairs)
    return InverseProblem(model, model.observables[0], observations, prior, FIXED, acting)


def response(x0, v0):
    """Position (K,) from x0, v0: linear in both."""
    (path,) = Oscillator(OscillatorSettings()).trajectories(np.array([[x0, v0, FIXED["k"], FIXED["c"]]]), TIMES)
    return path["x"]


@pytest.mark.parametrize(("linearisation", "tolerance"), [("transform", 1e-12), ("bundle", 1e-9)])
def test_additive_perturbations_against_the_kalman_smoother(linearisation, tolerance):
    values = response(1.1, -0.4) + STD * np.random.default_rng(1).standard_normal(12)
    problem = oscillator(("x", "0.2 m"), ("v", "0.5 m/s"), values=values)
    settings = AssimilationSettings(members=12, start="prior-mean", max_iterations=1, linearisation=linearisation)
    analysis = assimilate(problem, settings, 1)
    h = np.column_stack([response(1.0, 0.0), response(0.0, 1.0)])
    precision = np.diag([1 / 0.04, 1 / 0.25]) + h.T @ h / STD**2
    expected = np.linalg.solve(precision, h.T @ (values - response(1.0, 0.0)) / STD**2)
    assert np.max(np.abs(analysis.posterior.mean(axis=0) - expected)) < tolerance
    assert np.max(np.abs(np.cov(analysis.posterior.T) - np.linalg.inv(precision))) < tolerance
    assert [(p.name, p.unit) for p in analysis.parameters] == [("initial_x", "m"), ("initial_v", "m/s")]
    assert expected[1] == pytest.approx(-0.4, abs=0.2)


def test_relative_perturbation_is_a_factor():
    problem = oscillator(("x", "5 %"))
    x = problem.prior.sample(6, 1)
    run = forecast(problem, x)
    assert run.predictions == pytest.approx(np.stack([response(f, 0.0) for f in np.exp(x[:, 0])]), rel=1e-12)
    assert x.std(ddof=1) == pytest.approx(0.05)


def test_a_share_of_what_begins_at_zero_is_no_spread():
    problem = oscillator(("v", "5 %"))
    run = forecast(problem, problem.prior.sample(6, 1))
    assert set(run.failures) == {
        "ValueError: v begins at 0, of which no share is a spread: give initial_state.v.std in its unit"
    }


def test_a_perturbation_leaves_the_state_of_the_model_alone():
    """The model's own array is not written to, and the other fields keep their values."""
    problem = oscillator(("v", "0.5 m/s"))
    shared = problem.model.initial_states({name: np.full(3, value) for name, value in FIXED.items()})
    kept = shared.copy()
    object.__setattr__(problem.model, "initial_states", lambda theta: shared)
    forecast(problem, np.array([[1.0], [2.0], [3.0]]))
    assert np.array_equal(shared, kept)


def test_block_is_perturbed_as_a_whole():
    from toys import OBSERVABLE, Linear

    model = Linear(("a", "b"))
    term, acting = perturbation(model.layout.fields[2], 0.5)
    problem = InverseProblem(
        model, OBSERVABLE, make_observations(TIMES, np.zeros(12)), Prior((term,)), {"a": 1.0, "b": -2.0}, (acting,)
    )
    expected = [model.curve(np.array([1.3, -1.7]), t) for t in TIMES]
    assert forecast(problem, np.array([[0.3]])).predictions[0] == pytest.approx(expected)


def test_incomplete_perturbations_are_refused():
    problem = oscillator(("v", "0.5 m/s"), ("x", "5 %"))
    assert check_problem(problem)
    with pytest.raises(ConfigError, match="w: not a field"):
        check_problem(
            replace(problem, perturbations=(*problem.perturbations[1:], replace(problem.perturbations[0], field="w")))
        )
    with pytest.raises(ConfigError, match="initial_x: neither fixed nor estimated"):
        check_problem(replace(problem, prior=Prior(problem.prior.terms[:1])))
    with pytest.raises(ConfigError, match="initial_x: not a parameter"):
        check_problem(replace(problem, perturbations=problem.perturbations[:1]))
