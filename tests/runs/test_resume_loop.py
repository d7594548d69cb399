"""An estimate continues after any of its forward runs to the same bits, and repeats none of them."""

from dataclasses import replace

import numpy as np
import pytest
from cut_anywhere import assert_cut_anywhere, gone_on, kept_runs
from same_bits import assert_same_bits
from toys import Decay, Linear, Wave, make_problem, with_noise

from en4dvar.results import checkpoint
from en4dvar.results.checkpoint import KnownRuns
from en4dvar.sampling import mcmc
from en4dvar.schemes.settings import AssimilationSettings


@pytest.mark.parametrize("starts", [1, 2])
@pytest.mark.parametrize("linearisation", ["bundle", "transform"])
def test_cut_after_any_forecast(linearisation, starts):
    settings = AssimilationSettings(members=9, linearisation=linearisation, starts=starts)
    wave = make_problem(Wave(), [1.0, 1.4])
    k = np.arange(len(wave.observations))
    correlated = with_noise(wave.observations, correlation=0.3 ** np.abs(k[:, None] - k))
    for problem in (
        make_problem(Decay(), [1.5, 1.2], time_std=0.02), wave, replace(wave, observations=correlated)
    ):  # fmt: skip
        assert len(assert_cut_anywhere(problem, settings, 3, cuts=7).iterations) > 3


def test_cut_in_later_descents():
    """Data that no descent explains, so that the next members are tried; the lowest of those before is not lost."""
    problem = make_problem(Decay(), [1.5, 1.2])
    observations = problem.observations
    away = np.where(np.arange(len(observations)) % 2, 10.0, -10.0) * observations.std
    problem = replace(problem, observations=replace(observations, values=observations.values + away))
    assert_cut_anywhere(problem, AssimilationSettings(members=9), 3)


@pytest.mark.parametrize("scheme", ["en4dvar", "es-mda"])
@pytest.mark.slow
def test_cut_in_a_chain(scheme, monkeypatch):
    monkeypatch.setattr(mcmc.sample, "__kwdefaults__", {**mcmc.sample.__kwdefaults__, "max_steps": 210})
    settings = AssimilationSettings(scheme=scheme, members=9, refine="mcmc")
    assert_cut_anywhere(make_problem(Decay(), [1.5, 1.2]), settings, 3, cuts=6)


def test_other_runs_than_those_asked_for_are_not_taken():
    """From where a journal holds something else on, the model is run."""
    problem, settings = make_problem(Linear(("a", "b")), [1.0, -0.5]), AssimilationSettings(members=9)
    whole, runs = kept_runs(problem, settings, 3)
    wrong = KnownRuns((*runs.keys[:2], "0" * 64, *runs.keys[3:]), runs.forecasts)
    again, made = gone_on(problem, settings, 3, wrong, len(wrong.keys))
    assert_same_bits(again, whole)
    assert made == len(runs.keys) - 2


def test_a_journal_that_is_full_keeps_what_it_has(monkeypatch):
    """What did not find room is run again, and the bits are the same."""
    problem, settings = make_problem(Decay(), [1.5, 1.2]), AssimilationSettings(members=9)
    whole, runs = kept_runs(problem, settings, 3)
    monkeypatch.setattr(checkpoint, "LARGEST", sum(run.nbytes for run in runs.forecasts[:3]))
    full, some = kept_runs(problem, settings, 3)
    assert_same_bits(full, whole)
    assert some.keys == runs.keys[:3]
    again, made = gone_on(problem, settings, 3, some, 3)
    assert_same_bits(again, whole)
    assert made == len(runs.keys) - 3
