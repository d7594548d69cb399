"""Readings that some members lack: the posterior is that of the closed form, as if none were missing."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from same_bits import assert_same_bits
from toys import Decay, Vectorised, make_problem

from en4dvar.ensemble.forecast import forecast
from en4dvar.ensemble.missing import filled, fitted
from en4dvar.estimation.assimilate import assimilate
from en4dvar.executor import ProcessesExecutor, SerialExecutor
from en4dvar.model.forward import Observable
from en4dvar.plumbing.errors import TooFewMembersError
from en4dvar.schemes import ON_A_WINDOW
from en4dvar.schemes.settings import AssimilationSettings

NAMES, TRUTH, SHARE = ("a", "b", "c"), np.array([1.0, -0.5, 0.7]), 0.3


@dataclass(frozen=True)
class Patchy:
    """y, of which each run lacks a random share of the readings; of some runs every one is the ``worst``."""

    share: float = SHARE
    worst: float = np.nan
    lost: float = 0.0

    def __call__(self, path):
        y, theta = np.array(path["y"], dtype=float), np.ascontiguousarray(path["theta"][0])
        rng = np.random.default_rng(theta.view(np.uint64))
        y[rng.random(len(y)) < self.share] = np.nan
        return np.full(len(y), self.worst) if rng.random() < self.lost else y


def patchy(model, truth, seed=1, operator=None, **options):
    problem = make_problem(model, truth, seed=seed, **options)
    return problem, replace(problem, observable=Observable("y", "m", operator or Patchy()))


def settings(**options):
    return AssimilationSettings(**{"members": 40, "refine": "none", "what_if": False, **options})


def posterior(problem):
    h = np.array([[problem.model.curve(row, t) for row in np.eye(3)] for t in problem.observations.times])
    precision = np.eye(3) + h.T @ h / 0.01
    mean = np.linalg.solve(precision, 0.8 * TRUTH + h.T @ problem.observations.values / 0.01)
    return mean, np.linalg.inv(precision)


@pytest.mark.parametrize("linearisation", ["bundle", "transform"])
@pytest.mark.parametrize("step_control", ["line-search", "levenberg-marquardt", "full"])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_third_of_the_readings_missing_leaves_the_posterior(linearisation, step_control, seed):
    _, problem = patchy(Vectorised(NAMES), TRUTH, seed)
    analysis = assimilate(problem, settings(linearisation=linearisation, step_control=step_control), seed)
    mean, cov = posterior(problem)
    std = np.sqrt(np.diag(cov))
    assert analysis.converged
    assert not any(analysis.posterior_failures)
    assert np.max(np.abs(analysis.posterior.mean(axis=0) - mean) / std) < 1e-3
    assert np.cov(analysis.posterior.T) == pytest.approx(cov, rel=1e-3, abs=1e-3 * std.max() ** 2)
    (found,) = [c for c in analysis.cautions if c.code == "readings-missing"]
    assert float(found.words.split(" %")[0]) == pytest.approx(30, abs=8)


@pytest.mark.parametrize("refine", ["auto", "mcmc"])
def test_no_chain_is_run_to_which_a_draw_without_a_reading_is_impossible(refine):
    """It would end where few readings are missing, and nowhere else."""
    _, problem = patchy(Vectorised(NAMES), TRUTH)
    analysis = assimilate(problem, settings(refine=refine), 1)
    mean, cov = posterior(problem)
    assert not analysis.refinement
    assert np.max(np.abs(analysis.posterior.mean(axis=0) - mean) / np.sqrt(np.diag(cov))) < 1e-3
    (found,) = [c for c in analysis.cautions if c.code == "readings-missing"]
    assert (found.severity == "serious") == (refine == "mcmc") == ("refine: mcmc" in found.words)


@pytest.mark.parametrize("scheme", [name for name in ON_A_WINDOW if name != "particle-filter"])
def test_every_scheme_of_a_window_gives_what_it_gives_without_gaps(scheme):
    whole, problem = patchy(Vectorised(NAMES), TRUTH)
    each = [assimilate(p, settings(scheme=scheme), 4) for p in (whole, problem)]
    assert each[1].posterior == pytest.approx(each[0].posterior, abs=1e-6)


def test_a_curved_model_finds_its_minimum():
    whole, problem = patchy(Decay(), np.array([1.0, 0.8]), scale=0.3)
    each = [assimilate(p, settings(), 4) for p in (whole, problem)]
    std = each[0].posterior.std(axis=0)
    assert np.max(np.abs(each[1].centre - each[0].centre) / std) < 0.02
    assert each[1].posterior.std(axis=0) == pytest.approx(std, rel=0.05)


@pytest.mark.slow
def test_the_same_bits_for_any_worker_count():
    _, problem = patchy(Vectorised(NAMES), TRUTH)
    alone = assimilate(problem, settings(), 4, SerialExecutor())
    with ProcessesExecutor(2) as executor:
        assert_same_bits(alone, assimilate(problem, settings(), 4, executor))


def test_a_member_without_any_reading_or_with_an_infinite_one_has_failed():
    for worst in (np.nan, np.inf):
        _, problem = patchy(Vectorised(NAMES), TRUTH, operator=Patchy(worst=worst, lost=0.2))
        x = problem.prior.sample(40, 0)
        run = forecast(problem, x)
        full = filled(run, x)
        lost = [bool(reason) for reason in full.failures]
        assert 2 < sum(lost) < 16
        assert {reason for reason in full.failures if reason} == {"non-finite prediction"}
        assert np.isnan(full.predictions[lost]).all()
        h = np.array([[problem.model.curve(row, t) for row in np.eye(3)] for t in problem.observations.times])
        alive = ~np.array(lost)
        assert full.predictions[alive] == pytest.approx(x[alive] @ h.T, abs=1e-12)
        assert full.filled == pytest.approx(np.isnan(run.predictions[alive]).mean())


def test_a_reading_that_no_member_gives_loses_all():
    _, problem = patchy(Vectorised(NAMES), TRUTH, operator=lambda path: np.where(np.arange(9) == 3, np.nan, path["y"]))
    with pytest.raises(TooFewMembersError, match="non-finite prediction"):
        assimilate(problem, settings(), 4)


def test_what_the_others_do_not_determine_stays_missing():
    x = np.array([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0], [0.0, 1.0]])
    values = np.column_stack([[1.0, 3.0, np.nan, 4.0], [1.0, 3.0, 5.0, np.nan], [np.nan] * 4])
    done = fitted(x, values)
    assert done[:, 0] == pytest.approx([1.0, 3.0, 5.0, 4.0])
    assert np.isnan(done[3, 1])
    assert np.isnan(done[:, 2]).all()


@pytest.mark.parametrize("most", [-np.inf, 0.0])
def test_a_run_that_ends_for_a_reading_that_too_few_members_have_names_it(most):
    """No member has it, or those on the other side of the prior mean than the minimum."""

    def lacking(path):
        y = np.array(path["y"], dtype=float)
        y[3] = np.where(path["theta"][0, 0] > most, np.nan, y[3])
        return y

    _, problem = patchy(Vectorised(NAMES), TRUTH, operator=lacking)
    problem.model.time_display_unit = "ms"
    problem = replace(problem, observations=replace(problem.observations, zero=0.5))
    time = 1e3 * (problem.observations.times[3] + 0.5)  # of the file, as the file's times are shown
    with pytest.raises(
        TooFewMembersError, match=rf"if any, have a number for reading 4 of y \(at {time:.6g} ms\): leave"
    ):
        assimilate(problem, settings(), 1)
    problem = replace(problem, observable=Observable("y", "m", lambda path: np.full(len(path["y"]), np.nan)))
    with pytest.raises(TooFewMembersError, match=r"non-finite prediction \(40×\)$"):
        assimilate(problem, settings(), 1)
