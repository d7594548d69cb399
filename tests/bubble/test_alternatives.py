"""What a bubble offers: alternatives whose predicted effect is that of a fit done again, and the ledger of its path."""

from __future__ import annotations

import shlex
from dataclasses import replace

import numpy as np
import pytest

from en4dvar.data.noise import noise_of
from en4dvar.data.observations import Observations
from en4dvar.diagnosis.response.what_if import changed_problem
from en4dvar.ensemble.forecast import forecast
from en4dvar.estimation.assimilate import assimilate
from en4dvar.priors.prior import Prior, PriorTerm
from en4dvar.problem import InverseProblem
from en4dvar.schemes.settings import AssimilationSettings
from en4dvar_bubble import BubbleModel, NeoHookeanKelvinVoigt
from en4dvar_bubble.dynamics import MACH_LIMITS
from en4dvar_bubble.medium import Medium, saturated_vapour_pressure
from en4dvar_bubble.settings import BubbleSettings

SETTINGS = AssimilationSettings(starts=3, refine="none")  # what is predicted is linear: that of Gaussians
STD = 1.4e-6


def twin(model, prior, times, seed=1, spread=0.5):
    rng = np.random.default_rng(seed)
    truth = prior.mean + spread * prior.std * rng.standard_normal(len(prior.names))
    ones = np.ones(len(times))
    observations = Observations(times, ones, noise_of(STD * ones), ones)
    problem = InverseProblem(model, model.observables[0], observations, prior)
    values = forecast(problem, truth[None]).predictions[0] + STD * rng.standard_normal(len(times))
    return replace(problem, observations=replace(observations, values=values))


def acoustic(seed=1):
    model = BubbleModel()
    p = {p.name: p for p in model.parameters}
    medians = {"G": 500.0, "alpha": 0.03, "mu": 0.1, "R0": 0.5e-6}
    prior = Prior(tuple(PriorTerm.lognormal(p[name], median, 0.3) for name, median in medians.items()))
    return twin(model, prior, np.arange(6e-6, 24e-6, 1.5e-6), seed)


def laser(seed=1):
    model = BubbleModel(law=NeoHookeanKelvinVoigt(), start="laser", gas="polytropic")
    p = {p.name: p for p in model.parameters}
    terms = (
        PriorTerm.lognormal(p["G"], 4e3, 0.5),
        PriorTerm.lognormal(p["mu"], 0.06, 0.5),
        PriorTerm.normal(p["R_max"], 250e-6, 5e-6),
        PriorTerm.lognormal(p["R_eq"], 35e-6, 0.2),
    )
    return twin(model, Prior(terms), np.arange(0.7e-6, 40e-6, 1.4e-6), seed)


@pytest.fixture(scope="module")
def fits():
    """Problem and analysis of either start."""
    return {start: (p := make(), assimilate(p, SETTINGS, 1)) for start, make in STARTS.items()}


STARTS = {"acoustic": acoustic, "laser": laser}


@pytest.mark.parametrize(
    ("start", "name"),
    [
        ("acoustic", "pulse_amplitude"),
        ("acoustic", "length_scale"),
        ("laser", "time_scale"),
        ("laser", "length_scale"),
        ("laser", "stiffening"),
    ],
)
def test_the_predicted_change_is_that_of_a_fit_done_again(fits, start, name):
    problem, analysis = fits[start]
    (alternative,) = (one for one in problem.model.alternatives if one.name == name)
    (shift,) = (one for one in analysis.what_if if one.name == name)
    again = assimilate(changed_problem(problem, alternative), SETTINGS, 1)
    z = problem.prior.from_physical(analysis.posterior).std(axis=0, ddof=1)
    change = (problem.prior.from_physical(again.centre) - problem.prior.from_physical(analysis.centre)) / z
    assert np.abs(change).max() > 0.5  # more than rounding is predicted
    np.testing.assert_allclose(shift.in_std, change, rtol=0, atol=0.2 * np.abs(change).max())
    leading = np.abs(change).argmax()
    assert shift.in_std[leading] == pytest.approx(change[leading], rel=0.1)
    assert shift.cost_change == pytest.approx(again.iterations[-1].cost - analysis.iterations[-1].cost, abs=0.5)


@pytest.mark.slow
@pytest.mark.parametrize("start", STARTS)
def test_every_number_of_the_table_is_that_of_a_fit_done_again(fits, start):
    """Parameter by parameter: within 0.3 standard deviations or a quarter, and so in sign where it is more."""
    problem, analysis = fits[start]
    std = problem.prior.from_physical(analysis.posterior).std(axis=0, ddof=1)
    before = problem.prior.from_physical(analysis.centre)
    offered = {alternative.name: alternative for alternative in problem.model.alternatives}
    told = [shift for shift in analysis.what_if if shift.settled and shift.largest > 0.3]
    assert len(told) > 2
    for shift in told:
        changed = changed_problem(problem, offered[shift.name])
        if offered[shift.name].parameters:
            continue  # moves the prior
        again = assimilate(changed, replace(SETTINGS, what_if=False), 1)
        change = (problem.prior.from_physical(again.centre) - before) / std
        assert np.all(np.abs(shift.in_std - change) <= np.maximum(0.3, 0.25 * np.abs(change))), shift.name


@pytest.mark.parametrize("start", STARTS)
def test_the_influence_of_a_reading_is_that_of_a_fit_without_it(fits, start):
    """Of the three readings that move a parameter most."""
    problem, analysis = fits[start]
    o, mean, std = problem.observations, analysis.posterior.mean(axis=0), analysis.posterior.std(axis=0, ddof=1)
    found = analysis.influence.in_std
    for k in np.argsort(-np.abs(found).max(axis=0))[:3]:
        kept = np.arange(len(o)) != k
        rest = Observations(o.times[kept], o.values[kept], noise_of(o.std[kept]), o.weights[kept])
        again = assimilate(replace(problem, observations=rest), replace(SETTINGS, what_if=False), 1)
        change = (again.posterior.mean(axis=0) - mean) / std
        assert np.abs(change).max() > 0.05
        np.testing.assert_allclose(found[:, k], change, rtol=0, atol=0.02 if start == "acoustic" else 0.15)


@pytest.mark.parametrize("start", STARTS)
def test_every_alternative_is_told_or_has_a_reason(fits, start):
    problem, analysis = fits[start]
    offered = {one.name for one in problem.model.alternatives}
    own = {"pulse_amplitude"} if start == "acoustic" else {"stiffening"}  # the law of the former stiffens already
    common = {"ambient_pressure", "density", "sound_speed", "surface_tension", "gas_model", "vapour", "radius_at_rest"}
    common |= {"wall"}
    assert offered == own | common | {"length_scale", "time_scale"}
    assert {one.name for one in analysis.what_if} == offered
    for shift in analysis.what_if:
        assert np.isfinite(shift.change).all() != bool(shift.reason)


@pytest.mark.parametrize(
    "options",
    [
        {"vapour": "frozen"},
        {"start": "laser", "vapour": "transport", "medium_heat": "conducting"},
        {"gas": "isothermal"},
        {"gas": "polytropic", "start": "laser"},
        {"named": ("A",)},
        {"start": "laser", "vapour": "transport", "named": ("D_v",)},
        {"start": "laser", "vapour": "transport", "medium_heat": "conducting", "named": ("K_m", "T_inf")},
    ],
)
def test_alternatives_can_be_made_for_any_options(options):
    model = BubbleModel(**options)
    others = [one.model for one in model.alternatives if one.model is not None]
    assert others
    assert all([p.name for p in other.parameters] == [p.name for p in model.parameters] for other in others)


def test_what_the_equations_do_not_contain_is_no_alternative():
    """Of an incompressible liquid the speed of sound was told to make no difference, for the price of a forecast."""
    offered = {radial: [one.name for one in BubbleModel(radial=radial).alternatives] for radial in MACH_LIMITS}
    assert [radial for radial, names in offered.items() if "sound_speed" not in names] == ["rayleigh-plesset"]


def test_of_the_fullest_physics_every_part_could_be_simpler():
    fullest = BubbleModel(start="laser", vapour="transport", medium_heat="conducting")
    other = {one.name: one.model for one in fullest.alternatives if one.model is not None}
    physics = {name: (model.gas, model.vapour, model.medium_heat) for name, model in other.items()}
    assert physics["medium_heat"] == ("heat", "transport", "cold")
    assert physics["vapour"] == ("heat", "none", "conducting")
    assert physics["gas_model"] == ("polytropic", "none", "cold")
    simple = other["gas_model"].medium
    assert simple.p_v == saturated_vapour_pressure(simple.T_inf)  # so that R_eq means the same


def test_vapour_may_diffuse_by_kinetic_theory():
    """R_eq differs by a fifth; where the diffusivity is stated, or its exponent estimated, there is no such row."""

    def offered(**options):
        made = BubbleModel(start="laser", vapour="transport", **options).alternatives
        return [(one.model.medium.D_p, one.model.medium.D_T) for one in made if one.name == "diffusivity"]

    assert offered() == [(1.0, 1.75)]
    assert not offered(medium=Medium(D_p=1.0, D_T=1.75))
    assert not offered(named=("D_p",))


def test_alternatives_are_not_sent_along_with_the_model():
    model = BubbleModel()
    assert model.alternatives is model.alternatives
    assert not any("alternative" in key for key in vars(model))


@pytest.mark.parametrize("start", STARTS)
def test_a_path_can_be_resumed_from_any_instant(start):
    problem = STARTS[start]()
    model = problem.model
    values = dict(zip(problem.prior.names, problem.prior.to_physical(problem.prior.mean), strict=True))
    x = model.initial_state(values)[None]
    times = np.linspace(0, 22e-6, 45)
    (whole,) = model.trajectories(x, times)
    starts = times[[10, 21, 30]]
    resumed = model.resumed(whole.states[[10, 21, 30]], starts, np.broadcast_to(times, (3, 45)))
    for path, begin in zip(resumed, starts, strict=True):
        later = times >= begin
        np.testing.assert_allclose(path["R"][later], whole["R"][later], rtol=2e-3)


def test_viscosity_is_informed_only_where_the_wall_moves(fits):
    _, analysis = fits["acoustic"]
    book = analysis.ledger
    assert book.parameters == ("G", "alpha", "mu")
    np.testing.assert_allclose(book.weights.sum(axis=1), 1.0)
    before_pulse = book.edges[1:] < 4.4e-6
    assert before_pulse.any()
    assert book.weights[:, before_pulse].max() < 1e-3
    G, _, mu = book.quantiles[:, 0, 1]  # medians of the strain rate
    assert mu > 10 * G
    assert book.quantiles[0, 1, 1] > 50  # stretch where the modulus is felt
    assert 1e5 < mu < 1e8


@pytest.mark.parametrize("start", STARTS)
def test_the_kernels_sum_to_the_degrees_of_freedom(fits, start):
    problem, analysis = fits[start]
    of_law = [problem.prior.names.index(name) for name in analysis.ledger.parameters]
    np.testing.assert_allclose(analysis.ledger.kernel.sum(axis=1), analysis.dfs_per_parameter[of_law], atol=0.03)


@pytest.mark.parametrize(
    "settings",
    [
        {"vapour": "transport", "medium_heat": "conducting"},
        {"vapour_pressure": "saturated"},
        {"gas": "polytropic"},
        {"start": "acoustic"},
    ],
    ids=str,
)
def test_the_options_of_an_alternative_make_its_model(settings):
    """Those that a result prints where the readings speak for it."""
    said = {"law": "neo-hookean-kelvin-voigt", "start": "laser", "gas": "heat", **settings}
    told = [it for it in BubbleModel.from_settings(BubbleSettings.model_validate(said)).alternatives if it.options]
    assert {"stiffening", "gas_model", "vapour"} <= {it.name for it in told}
    for alternative in told:
        changed, words = dict(said), shlex.split(alternative.options)
        for key, _, value in (word.partition("=") for word in words if word != "--set"):
            section, _, name = key.partition(".")
            if section == "model":
                changed[name] = value
            else:
                assert float(value) == {**vars(alternative.model.medium), **alternative.constants}[name]
        made = BubbleModel.from_settings(BubbleSettings.model_validate(changed))
        other = alternative.model
        assert (type(made.law), made.gas, made.vapour, made.medium_heat) == (
            type(other.law), other.gas, other.vapour, other.medium_heat
        ), alternative.name  # fmt: skip
        assert made.medium.p_v == pytest.approx(other.medium.p_v)
