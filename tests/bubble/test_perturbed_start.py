"""A laser bubble whose wall already moves and whose gas is not in the assumed state at time zero."""

from dataclasses import replace

import numpy as np
import pytest

from en4dvar.config.varies import perturbation
from en4dvar.data.noise import noise_of
from en4dvar.data.observations import Observations
from en4dvar.estimation.assimilate import assimilate, forecast
from en4dvar.priors.prior import Prior, PriorTerm
from en4dvar.problem import InverseProblem
from en4dvar.schemes.settings import AssimilationSettings
from en4dvar_bubble.medium import saturated_vapour_pressure
from en4dvar_bubble.model import BubbleModel
from en4dvar_bubble.settings import BubbleSettings

FIXED = {"mu": 0.1, "R_eq": 40e-6, "R_max": 250e-6}
TIMES = np.linspace(0, 45e-6, 40)  # one collapse and the rebound
STD = 1e-6


def laser(values=None):
    settings = BubbleSettings(law="neo-hookean-kelvin-voigt", start="laser", gas="polytropic")
    model = BubbleModel.from_settings(settings)
    fields = {f.name: f for f in model.layout}
    pairs = [perturbation(fields["Rdot"], "4 m/s"), perturbation(fields["p_b"], "5 %")]
    G = next(p for p in model.parameters if p.name == "G")
    prior = Prior((PriorTerm.lognormal(G, 3000.0, 0.4), *(term for term, _ in pairs)))
    ones = np.ones(len(TIMES))
    observations = Observations(TIMES, ones if values is None else values, noise_of(STD * ones), ones)
    observable = next(o for o in model.observables if o.name == "radius")
    return InverseProblem(model, observable, observations, prior, FIXED, tuple(p for _, p in pairs))


def test_velocity_and_gas_pressure_change_the_run():
    problem = laser()
    x = np.array([[np.log(3000.0), 0.0, 0.0], [np.log(3000.0), 3.0, 0.0], [np.log(3000.0), 0.0, np.log(1.2)]])
    run = forecast(problem, x)
    assert run.active.all()
    h = TIMES[1]
    assert run.predictions[1, 1] - run.predictions[0, 1] == pytest.approx(3.0 * h, rel=0.05)
    states = problem.model.initial_states({"G": np.full(3, 3000.0), **{k: np.full(3, v) for k, v in FIXED.items()}})
    states[1, problem.model.layout["Rdot"]] += 3.0
    states[2, problem.model.layout["p_b"]] *= 1.2
    direct = np.stack([path["R"] for path in problem.model.trajectories(states, TIMES)])
    np.testing.assert_allclose(run.predictions, direct, rtol=1e-12)
    assert np.max(np.abs(run.predictions[2] - run.predictions[0])) > 1e-6


def test_a_member_without_gas_fails_alone():
    problem = laser()
    fields = {f.name: f for f in problem.model.layout}
    (pressure, by), (radius, size) = perturbation(fields["p_b"], "1 kPa"), perturbation(fields["R"], "10 um")
    problem = replace(problem, prior=Prior((problem.prior.terms[0], pressure, radius)), perturbations=(by, size))
    run = forecast(problem, np.array([[8.0, 0.0, 0.0], [8.0, -1e4, 0.0], [8.0, 0.0, -3e-4], [8.0, 1e3, 1e-6]]))
    assert run.active.tolist() == [True, False, False, True]
    assert "perturbed initial p_b outside (" in run.failures[1]
    assert "perturbed initial R outside (0, inf) m" in run.failures[2]
    assert np.array_equal(run.predictions[0], forecast(problem, np.array([[8.0, 0.0, 0.0]])).predictions[0])


@pytest.mark.slow
def test_twin_with_a_moving_wall_is_recovered():
    """Truth: 2500 Pa, 3 m/s outwards. A model that starts at rest cannot explain the data."""
    problem = laser()
    truth = np.array([np.log(2500.0), 3.0, 0.0])
    values = forecast(problem, truth[None]).predictions[0] + STD * np.random.default_rng(0).standard_normal(len(TIMES))
    analysis = assimilate(laser(values), AssimilationSettings(), 1)
    assert analysis.converged
    assert [p.name for p in analysis.parameters] == ["G", "initial_Rdot", "initial_p_b"]
    assert [p.unit for p in analysis.parameters] == ["Pa", "m/s", "1"]
    mean, std = analysis.posterior.mean(axis=0), analysis.posterior.std(axis=0, ddof=1)
    assert np.all(np.abs(mean - [2500.0, 3.0, 1.0]) < 3 * std)
    assert std[1] < 0.4
    at_rest = laser(values)
    prior = Prior(at_rest.prior.terms[:1])
    wrong = assimilate(
        InverseProblem(at_rest.model, at_rest.observable, at_rest.observations, prior, FIXED), AssimilationSettings(), 1
    )
    assert wrong.iterations[-1].chi2_per_observation > 3 > analysis.iterations[-1].chi2_per_observation
    assert any("does not explain the data" in words for words in wrong.warnings)


@pytest.mark.parametrize("factor", [0.5, 1.0, 3.0])
@pytest.mark.parametrize(
    "physics",
    [
        {"gas": "isothermal", "vapour_pressure": "saturated"},
        {"gas": "heat", "vapour": "transport"},
        {"gas": "heat", "vapour": "transport", "medium_heat": "conducting"},
    ],
)
def test_gas_that_changes_on_the_way_is_that_of_the_radius_at_rest(physics, factor):
    """p_g R³ at rest, T_∞ again, is ``factor`` times that of R_eq: no elasticity, the pressure of an equilibrium."""
    settings = {**physics, "start": "laser", "law": "newtonian", "driving": {"kind": "none"}}
    model = BubbleModel.from_settings(BubbleSettings.model_validate(settings))
    theta = {"mu": np.array([0.08]), "R_eq": np.array([30e-6]), "R_max": np.array([150e-6])}
    path = model.integrate(model.initial_states(theta), np.array([[18e-6]]))
    assert path["R"][0, 0] > 35e-6  # on the way, with a Ṙ
    changed = model.changed("gas", path.states[:, 0], np.log([factor]))
    rest = model.integrate(changed, np.array([[2e-3]]), 18e-6)["R"][0, 0]
    medium = model.medium
    vapour = saturated_vapour_pressure(medium.T_inf) if physics.get("vapour") == "transport" else medium.p_v

    def amount(R):
        return (medium.p_inf + 2 * medium.S / R - vapour) * R**3

    assert amount(rest) == pytest.approx(factor * amount(30e-6), rel=0.01)
    other = model.changed("mu", path.states[:, 0], np.log([factor]))
    assert other[0, model.layout["mu"]] == pytest.approx(0.08 * factor)


def test_a_change_of_viscosity_is_that_of_all_viscosities_of_the_law():
    settings = {"start": "laser", "law": "carreau", "driving": {"kind": "none"}, "viscosity_change": 0.7}
    model = BubbleModel.from_settings(BubbleSettings.model_validate(settings))
    theta = {"R_eq": 30e-6, "R_max": 150e-6} | {p.name: 0.5 for p in model.law.parameters}
    x = model.initial_states({name: np.array([value]) for name, value in theta.items()})
    (name,) = model.unforeseen
    expected = x.copy()
    for viscosity in ("mu_0", "mu_inf"):
        expected[:, model.layout[viscosity]] *= 3
    np.testing.assert_allclose(model.changed(name, x, np.log([3.0])), expected, rtol=1e-12)
