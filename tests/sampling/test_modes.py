"""Posteriors of two modes whose masses are known by quadrature."""

from dataclasses import replace

import numpy as np
import pytest
from same_bits import assert_same_bits
from wells import UnlikeWells, Wells, two_wells

from en4dvar.assimilate import assimilate, log_posterior
from en4dvar.executor import ThreadsExecutor
from en4dvar.problem import AssimilationSettings
from en4dvar.sampling import mcmc
from en4dvar.summary import summarise

KEYWORDS = mcmc.sample.__kwdefaults__


def mass_of_positive(problem):
    """Of a > 0, and J at its minimum on either side, on a grid."""
    axes = [m + s * np.linspace(-5, 5, 161) for m, s in zip(problem.prior.mean, problem.prior.std, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    logs = log_posterior(problem, grid)
    p = np.exp(logs - logs.max())
    return p[grid[:, 0] > 0].sum() / p.sum()


CASES = [(Wells, 0.3), (Wells, 0.0), (UnlikeWells, 0.3), (UnlikeWells, 0.8)]


@pytest.mark.parametrize(("kind", "mean"), CASES)
def test_weights_are_the_masses_of_the_wells(kind, mean):
    problem = two_wells(kind, mean=mean)
    expected = mass_of_positive(problem)
    analysis = assimilate(problem, AssimilationSettings(), 1)
    assert len(analysis.modes) == 2
    assert 0.05 < expected < 0.95
    positive = sum(mode.weight for mode in analysis.modes if mode.centre[0] > 0)
    assert positive == pytest.approx(expected, abs=0.03)
    assert np.mean(analysis.posterior[:, 0] > 0) == pytest.approx(expected, abs=0.03)
    assert sum(mode.weight for mode in analysis.modes) == pytest.approx(1)
    (told,) = (c for c in analysis.cautions if c.code == "several-modes")
    assert told.parameters == ("a",)  # b is the same in both
    a, b = summarise(analysis)
    assert (a.modal, b.modal) == (True, False)
    assert a.q05 < 0 < a.q95


@pytest.mark.parametrize("case", CASES[::2])
def test_a_chain_moves_between_the_wells(case):
    problem = two_wells(*case[:1], mean=case[1])
    analysis = assimilate(problem, AssimilationSettings(refine="mcmc"), 1)
    assert analysis.refinement["mcmc_converged"]
    positive = sum(mode.weight for mode in analysis.modes if mode.centre[0] > 0)
    assert positive == pytest.approx(mass_of_positive(problem), abs=0.03)


def test_without_jumps_walkers_of_two_wells_do_not_agree(monkeypatch):
    """R-hat compares walkers that started in different modes, so that it is near 1 only where they were exchanged."""
    problem = two_wells()
    problem = replace(problem, observations=replace(problem.observations, values=problem.observations.values + 3.0))
    jumping = assimilate(problem, AssimilationSettings(refine="mcmc"), 1)
    monkeypatch.setattr("en4dvar.sampling.mcmc._jump", lambda proposal: lambda x, random: (x, np.zeros(len(x))))
    monkeypatch.setattr("en4dvar.sampling.mcmc.MAX_R_HAT", 0.0)  # all steps there are
    monkeypatch.setattr("en4dvar.sampling.mcmc.sample.__kwdefaults__", {**KEYWORDS, "max_steps": 300})
    stuck = assimilate(problem, AssimilationSettings(refine="mcmc"), 1)
    assert jumping.refinement["mcmc_r_hat"] < 1.1 < stuck.refinement["mcmc_r_hat"]


def test_one_seed_gives_the_same_bits_for_any_workers():
    one = assimilate(two_wells(), AssimilationSettings(), 1)
    with ThreadsExecutor(2) as executor:
        assert_same_bits(assimilate(two_wells(), AssimilationSettings(), 1, executor), one)


def test_of_a_model_that_is_not_cheap_the_other_minimum_is_told():
    slow = assimilate(two_wells(compiled=False, mean=0.0), AssimilationSettings(), 1)
    assert slow.refinement == {}
    assert len(slow.modes) == 2
    (told,) = (c for c in slow.cautions if c.code == "several-modes")
    assert told.severity == "serious"
    assert all(row.untrusted == ("several-modes",) for row in summarise(slow))


def test_the_evidence_is_that_of_both_wells():
    problem = two_wells(mean=0.0)
    axes = [m + s * np.linspace(-6, 6, 161) for m, s in zip(problem.prior.mean, problem.prior.std, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    cell = np.prod([a[1] - a[0] for a in axes])
    logs = log_posterior(problem, grid) + problem.prior.log_density(problem.prior.mean)
    exact = np.logaddexp.reduce(logs) + np.log(cell) - problem.observations.log_normalisation()
    analysis = assimilate(problem, AssimilationSettings(), 1)
    assert analysis.log_evidence == pytest.approx(exact, abs=0.1)
