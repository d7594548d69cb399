"""The bubble with a viscosity that varies: the compiled solver goes on from piece to piece."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from varies import with_one_knot

from en4dvar.data.noise import noise_of
from en4dvar.data.observations import Observations
from en4dvar.diagnosis.response.what_if import changed_problem
from en4dvar.estimation.assimilate import assimilate
from en4dvar.priors.prior import Prior, PriorTerm
from en4dvar.priors.varying import PiecewiseModel, RandomWalk
from en4dvar.problem import InverseProblem
from en4dvar.report.export import is_math
from en4dvar.report.text import symbol_html
from en4dvar.schemes.settings import AssimilationSettings
from en4dvar_bubble.laws import get_law
from en4dvar_bubble.model import BubbleModel
from en4dvar_bubble.solver.driver import Accuracy

TRUTH = {"G": 500.0, "alpha": 0.03, "mu": 0.1, "R0": 0.5e-6}
COLLAPSE = 31e-6  # at these parameters
TIMES = np.arange(6e-6, 60e-6, 1.4e-6)


def priors(model):
    return tuple(PriorTerm.lognormal(p, TRUTH[p.name], 0.3 if p.name != "R0" else 0.05) for p in model.parameters)


def varied(model, knots=(COLLAPSE,), std=0.5):
    return PiecewiseModel(model, [RandomWalk.of(model, priors(model)[2], knots, std)])


def theta(members, changes):
    values = {name: np.full(members, value) for name, value in TRUTH.items()}
    return values | {f"mu_change_{k}": np.asarray(change, dtype=float) for k, change in enumerate(changes, 1)}


def test_without_a_change_the_path_is_that_of_the_constant_model():
    fine = BubbleModel(accuracy=Accuracy(nodes=4, rtol=1e-9))
    model = varied(fine, knots=(10e-6, 25e-6, 40e-6))
    paths = model.trajectories(model.initial_states(theta(3, np.zeros((3, 3)))), TIMES)
    (whole,) = fine.trajectories(fine.initial_states({k: np.array([v]) for k, v in TRUTH.items()}), TIMES)
    assert paths[0]["R"] == pytest.approx(whole["R"], rel=1e-6)
    assert paths[0].largest("wall_mach") == pytest.approx(whole.largest("wall_mach"), rel=1e-3)
    (limit,) = fine.validity
    assert [path.beyond(limit) for path in paths] == pytest.approx(np.full(3, whole.beyond(limit)), rel=1e-4)
    assert all(path["strain_rate"].shape == (len(TIMES),) for path in paths)


def test_a_change_is_that_of_the_model_resumed_with_the_other_value():
    bubble = BubbleModel()
    model = varied(bubble)
    x = model.initial_states(theta(2, [[np.log(0.5), np.log(2.0)]]))
    paths = model.trajectories(x, TIMES)
    before = bubble.integrate(x[:, : bubble.layout.size], np.full((2, 1), COLLAPSE)).states[:, -1]
    for i, factor in enumerate((0.5, 2.0)):
        at = before[i].copy()
        at[bubble.layout["mu"]] *= factor
        (after,) = bubble.resumed(at[None], np.array([COLLAPSE]), TIMES[None])
        later = TIMES > COLLAPSE
        assert paths[i]["R"][later] == pytest.approx(after["R"][later], rel=1e-12)
        assert paths[i]["mu"] == pytest.approx(np.where(later, 0.1 * factor, 0.1))
    assert np.array_equal(paths[0]["R"][~later], paths[1]["R"][~later])


def test_alternatives_vary_too():
    bubble = BubbleModel()
    model = varied(bubble)
    assert "mu" not in model.path_parameters
    assert "mu" in bubble.path_parameters
    offered = model.alternatives
    assert [one.name for one in offered] == [one.name for one in bubble.alternatives]
    own = [one for one in offered if one.model is not None]
    assert own
    assert all(isinstance(one.model, PiecewiseModel) and one.model.varying == model.varying for one in own)


LASER = {"G": 4e3, "mu": 0.06, "R_eq": 35e-6, "R_max": 250e-6}
SPREAD = {"G": 0.5, "mu": 0.5, "R_eq": 0.2, "R_max": 0.02}
FIRST_COLLAPSE, READINGS = 22.5e-6, np.arange(0.7e-6, 60e-6, 1.4e-6)


@pytest.fixture(scope="module")
def halved():
    """A twin of a laser bubble whose viscosity is halved at the first collapse."""
    model, k, noise = BubbleModel(law=get_law("neo-hookean-kelvin-voigt"), start="laser"), len(READINGS), 0.5e-6
    terms = tuple(PriorTerm.lognormal(p, LASER[p.name], SPREAD[p.name]) for p in model.parameters)
    true = PiecewiseModel(model, [RandomWalk.of(model, terms[1], (FIRST_COLLAPSE,), 0.5)])
    given = {name: np.array([value]) for name, value in {**LASER, "mu_change_1": -np.log(2)}.items()}
    (path,) = true.trajectories(true.initial_states(given), READINGS)
    values = path["R"] + noise * np.random.default_rng(2).standard_normal(k)
    observations = Observations(READINGS, values, noise_of(np.full(k, noise), np.zeros(k)), np.ones(k))
    problem = InverseProblem(model, model.observables[0], observations, Prior(terms))
    problem = problem.varied([RandomWalk.of(model, terms[1], (11.25e-6, FIRST_COLLAPSE, 45e-6), 0.5)])
    return assimilate(problem, AssimilationSettings(emulator="off"), 1)


@pytest.mark.slow
def test_bands_cover_a_viscosity_that_is_halved_at_the_collapse(halved):
    pieces = halved.pieces(halved.problem.varying[0], halved.posterior)
    truth = np.array([0.06, 0.06, 0.03, 0.03])
    low, high = np.quantile(pieces, (0.05, 0.95), axis=0)
    assert np.all((low < truth) & (truth < high))
    assert high[2] < low[1]
    assert halved.log_evidence_change > np.log(20)


@pytest.mark.slow
def test_what_if_is_answered(halved):
    assert len(halved.what_if) > 0
    alternative = next(one for one in halved.problem.model.alternatives if one.model is not None)
    changed = changed_problem(halved.problem, alternative)
    assert changed.varying == halved.problem.varying
    assert replace(changed, model=halved.problem.model).varying == halved.problem.varying
    assert any(shift.settled for shift in halved.what_if)


def test_symbols_of_changes_can_be_printed():
    """As figures, pages and tables of papers have them."""
    symbol = varied(BubbleModel()).parameters[-1].symbol
    assert symbol == r"$\Delta_{1}(\mathrm{ln} \mu)$"
    assert is_math(symbol)
    assert symbol_html(symbol) == "<i>Δ</i><sub>1</sub><i>(ln μ)</i>"


@pytest.mark.slow
def test_a_minimum_that_no_member_leads_to_is_found_from_where_nothing_changes():
    """Of this twin with a knot in time, descents from the members agree on a minimum that is 78 std from the truth."""
    found = with_one_knot("in time 717")
    assert np.max(np.abs(found["z"])) < 3
    assert "misfit" not in found["warned"]
