"""30 % of all readings missing at random: fields, series, joint estimates and populations are as if none were."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from field_models import READ, TIMES, VALUES, Line
from toys import Vectorised, make_problem

from en4dvar.data.noise import noise_of
from en4dvar.data.observations import Observations
from en4dvar.data.series import Places, Series
from en4dvar.ensemble.missing import fitted
from en4dvar.estimation.assimilate import assimilate
from en4dvar.estimation.joint.estimate import estimate_jointly
from en4dvar.estimation.joint.problem import JointProblem
from en4dvar.estimation.population.own import own_draws
from en4dvar.executor import ProcessesExecutor, SerialExecutor
from en4dvar.model.forward import Observable, StateField
from en4dvar.priors.field_prior import FieldPrior
from en4dvar.priors.prior import Prior
from en4dvar.problem import InverseProblem
from en4dvar.schemes.filters import ETKF
from en4dvar.schemes.ienks import IEnKS
from en4dvar.schemes.settings import AssimilationSettings, Localisation
from en4dvar.series.sequential import CycleSeries, SequentialSettings, run_sequential
from en4dvar_lorenz import Linear as Oscillators
from en4dvar_lorenz import Lorenz96
from en4dvar_lorenz.linear import LinearSettings
from en4dvar_lorenz.lorenz96 import Lorenz96Settings

SHARE = 0.3


@dataclass(frozen=True)
class Gappy:
    """What an operator gives, each number missing by chance, the same chance for the same state."""

    operator: Any
    share: float = SHARE

    def __call__(self, path):
        values = np.array(self.operator(path), dtype=float)
        rows = values.reshape(len(values), -1)
        for state, row in zip(path.states, rows, strict=True):
            row[np.random.default_rng(np.ascontiguousarray(state).view(np.uint64)).random(len(row)) < self.share] = (
                np.nan
            )
        return values


@dataclass(frozen=True)
class OfRun(Gappy):
    """The chance of a run."""

    def __call__(self, path):
        values = np.array(self.operator(path), dtype=float)
        rng = np.random.default_rng(np.round(1e6 * path.states[0]).astype(np.int64).view(np.uint64))
        values[rng.random(values.shape) < self.share] = np.nan
        return values


class OfCells(StateField):
    """The cells of a field, each number missing by the chance of a run."""

    def __call__(self, path):
        return OfRun(StateField(self.name))(path)


def smooth(path):
    """Means of five cells, which no cell tells alone."""
    u = path["u"]
    return np.stack([u[:, max(0, c - 2) : c + 3].mean(axis=1) for c in range(30)], axis=1)


def field(operator, n_members, localisation):
    model = Line()
    observable = Observable("u", "K", operator)
    series = [Series(observable, TIMES, VALUES, noise_of(np.full(6, 0.3)), places=Places.at_indices(READ))]
    prior = FieldPrior(model.layout.fields[0], 1.0, "gaussian", 1.5)
    problem = InverseProblem(
        model, observable, Observations.of_series(series), Prior(()), {"offset": 0.0}, fields=(prior,)
    )
    settings = AssimilationSettings(scheme="es-mda", members=n_members, localisation=localisation)
    return assimilate(problem, settings, 4)


@pytest.mark.parametrize(
    ("localisation", "operators"),
    [
        (Localisation(3.0), (StateField("u"), OfCells("u"))),
        (Localisation(threshold=0.4), (StateField("u"), OfCells("u"))),
        (Localisation(threshold=0.4), (smooth, OfRun(smooth))),
    ],
    ids=["distance", "chance", "means"],
)
def test_a_field_keeps_its_width(localisation, operators):
    """With fewer members than cells."""
    whole, gappy = (field(operator, 28, localisation) for operator in operators)
    wide = whole.fields[0].std
    assert not any(gappy.posterior_failures)
    assert np.mean(gappy.fields[0].std / wide) == pytest.approx(1.0, abs=0.05)
    assert (
        np.sqrt(np.mean(((gappy.fields[0].mean - whole.fields[0].mean) / wide) ** 2)) < 0.3
    )  # ensembles of 28 differ by 0.19 by chance
    (told,) = [c for c in gappy.cautions if c.code == "readings-missing"]
    assert float(told.words.split(" %")[0]) == pytest.approx(30, abs=10)


def test_what_is_screened_is_exact_where_a_cell_is_read_and_chance_where_none_tells():
    rng = np.random.default_rng(0)
    x = rng.standard_normal((40, 500))
    values = np.column_stack([2 * x[:, 17] - 1, x[:, 3] + x[:, 400], rng.standard_normal(40)])
    gaps = np.where(rng.random(values.shape) < SHARE, np.nan, values)
    gaps[:, 2] = np.where(np.isnan(gaps[:, :2]).all(axis=1), values[:, 2], gaps[:, 2])  # no row without any value
    done = fitted(x, gaps)
    assert np.isfinite(done).all()
    np.testing.assert_allclose(done[:, :2], values[:, :2], atol=1e-10)
    np.testing.assert_array_equal(done[np.isfinite(gaps)], values[np.isfinite(gaps)])
    assert done[:, 2].std() < 1.6 * values[:, 2].std()


def of_first(path):
    return path.states[:, [0, 3, 4]] @ np.array([[1.0, 0.5, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])


@pytest.mark.parametrize("scheme", [ETKF(), IEnKS(lag=2)], ids=["etkf", "ienks"])
def test_a_series_is_that_without_gaps(scheme):
    """Of a linear operator: to rounding, whatever is missing."""
    model = Oscillators.from_settings(LinearSettings(oscillators=4))
    rng = np.random.default_rng(0)
    members = np.hstack([rng.standard_normal((24, 8)), np.full((24, 1), 0.1)])
    series = CycleSeries(0.3 * np.arange(1, 9), rng.standard_normal((8, 3)), np.full(3, 0.4))
    whole, gappy = (
        run_sequential(model, (Observable("seen", "1", operator),), members, series, SequentialSettings(scheme))
        for operator in (of_first, Gappy(of_first))
    )
    assert not gappy.failures
    np.testing.assert_allclose(gappy.analysis.mean, whole.analysis.mean, atol=1e-8)
    np.testing.assert_allclose(gappy.analysis.std, whole.analysis.std, atol=1e-8)


def test_a_chaotic_series_of_fewer_members_than_cells_keeps_its_width():
    model = Lorenz96.from_settings(Lorenz96Settings())
    rng = np.random.default_rng(2)
    truth = model.step(np.append(rng.standard_normal(40), 8.0), 0.0, 5.0)
    members = truth + np.pad(rng.standard_normal((30, 40)), ((0, 0), (0, 1)))
    times, path = 0.05 * np.arange(1, 31), []
    for _ in times:
        truth = model.step(truth, 0.0, 0.05)
        path.append(truth[:40])
    series = CycleSeries(times, np.array(path) + rng.standard_normal((30, 40)), np.ones(40))

    def squares(trajectory):
        return trajectory.states[:, :40] + 0.02 * trajectory.states[:, :40] ** 2

    runs = [
        run_sequential(model, (Observable("x", "1", o),), members, series, SequentialSettings(ETKF()))
        for o in (squares, Gappy(squares))
    ]
    wide = [run.analysis.std[5:].mean() for run in runs]
    assert wide[1] / wide[0] == pytest.approx(1.0, abs=0.05)


NAMES = ("a", "b", "c")


def experiments(gaps, count=2):
    found = []
    for e in range(count):
        problem = make_problem(Vectorised(NAMES), np.array([1.0, -0.5, 0.3 * e]), seed=e)
        problem = replace(problem, observations=replace(problem.observations, name=f"set {e}"))
        operator = problem.observable.operator
        found.append(replace(problem, observable=Observable("y", "m", OfRun(operator) if gaps else operator)))
    return found


def joint(gaps, executor=None):
    problems = experiments(gaps)
    settings = AssimilationSettings(members=30, what_if=False, emulator="off", refine="none")
    shared = JointProblem(tuple(problems), ({"a": "", "b": ""},) * len(problems))
    return estimate_jointly(shared, settings, 1, executor)


@pytest.mark.slow
def test_a_joint_estimate_is_that_without_gaps():
    whole, gappy = joint(False), joint(True)
    width = whole.shared.std(axis=0)
    assert gappy.converged
    np.testing.assert_allclose(gappy.shared_mode, whole.shared_mode, atol=1e-4 * width.min())
    np.testing.assert_allclose(gappy.shared.std(axis=0), width, rtol=1e-3)
    assert gappy.log_evidence == pytest.approx(whole.log_evidence, abs=1e-3)
    assert {c.code for c in gappy.cautions} - {c.code for c in whole.cautions} == {"readings-missing"}
    assert gappy.forward_runs > 5 * whole.forward_runs  # each run has others beside it


@pytest.mark.slow
def test_a_joint_estimate_with_gaps_has_the_same_bits_for_any_worker_count():
    alone = joint(True, SerialExecutor())
    with ProcessesExecutor(2) as executor:
        np.testing.assert_array_equal(joint(True, executor).members.border, alone.members.border)


@pytest.mark.slow
def test_a_likelihood_of_a_population_is_that_without_gaps():
    ((whole,), (gappy,)) = (experiments(gaps, 1) for gaps in (False, True))
    h = np.array([[whole.model.curve(row, t) for row in np.eye(3)] for t in whole.observations.times])
    start = np.random.default_rng(0).standard_normal((40, 3)) * 0.2
    draws = [own_draws(problem, start, 3) for problem in (whole, gappy)]
    assert draws[1].log_evidence == pytest.approx(draws[0].log_evidence, abs=0.02)  # a draw without any is lost
    scaled = h * whole.prior.std / whole.observations.std[:, None]
    exact = np.linalg.inv(np.eye(3) + scaled.T @ scaled)
    np.testing.assert_allclose(np.sqrt(np.diag(np.cov(draws[1].z.T))), np.sqrt(np.diag(exact)), rtol=0.1)
