"""The loop continues from any iteration to the same bits."""

from dataclasses import replace

import numpy as np
import pytest
from same_bits import assert_same_bits
from toys import Decay, Wave, make_problem, with_noise

from en4dvar.estimation.assimilate import LoopState, assimilate
from en4dvar.results.checkpoint import decode, encode
from en4dvar.sampling import mcmc
from en4dvar.schemes.settings import AssimilationSettings


def run(problem, settings, resume=None):
    """The analysis and the states it kept, as they come back from a file."""
    states = []
    analysis = assimilate(problem, settings, 3, resume=resume, keep=lambda state: states.append(state()))
    return analysis, [decode(encode(state), LoopState) for state in states]


@pytest.mark.parametrize("starts", [1, 2])
@pytest.mark.parametrize("linearisation", ["bundle", "transform"])
def test_resumed_from_any_iteration(linearisation, starts):
    settings = AssimilationSettings(members=9, linearisation=linearisation, starts=starts)
    wave = make_problem(Wave(), [1.0, 1.4])
    k = np.arange(len(wave.observations))
    correlated = with_noise(wave.observations, correlation=0.3 ** np.abs(k[:, None] - k))
    for problem in (
        make_problem(Decay(), [1.5, 1.2], time_std=0.02), wave, replace(wave, observations=correlated)
    ):  # fmt: skip
        whole, states = run(problem, settings)
        rounds = [state for state in states if state.comparison]
        search = [state for state in states if state.search]
        iterations = states[len(rounds) : len(states) - len(search)]
        # the moves of the start that was chosen are the first iterations, and part of the first state after it
        before = len(iterations[0].descent.records)
        assert len(iterations) == len(whole.iterations) - before >= 1
        assert len(rounds) >= before
        assert bool(rounds) == bool(before) == (starts > 1 and linearisation == "bundle")
        assert len(whole.iterations) > 3
        for i, state in enumerate(states):
            again, rest = run(problem, settings, state)
            assert_same_bits(again, whole)
            searching = state.search and (state.search.comparison or state.search.rival)
            once_more = bool(searching)  # where the descents before ended is linearised again
            assert len(rest) == len(states) - i + once_more  # nothing before the state is repeated


def test_resumed_in_later_descents():
    """Data that no descent explains, so that the next members are tried; the lowest of those before is not lost."""
    problem = make_problem(Decay(), [1.5, 1.2])
    observations = problem.observations
    away = np.where(np.arange(len(observations)) % 2, 10.0, -10.0) * observations.std
    problem = replace(problem, observations=replace(observations, values=observations.values + away))
    whole, states = run(problem, AssimilationSettings(members=9))
    firsts = [state.comparison.first for state in states if state.comparison]
    assert sorted(set(firsts)) == [0, 2]
    for state in states[: len(firsts)]:
        assert_same_bits(run(problem, AssimilationSettings(members=9), state)[0], whole)


@pytest.mark.parametrize("scheme", ["en4dvar", "es-mda"])
@pytest.mark.slow
def test_refinement_resumed_from_any_look_at_the_chain(scheme, monkeypatch):
    """The chain goes on where it was, with the same draws; its runs are not repeated and still counted."""
    monkeypatch.setattr(mcmc.sample, "__kwdefaults__", {**mcmc.sample.__kwdefaults__, "max_steps": 210})
    settings = AssimilationSettings(scheme=scheme, members=9, refine="mcmc")
    problem = make_problem(Decay(), [1.5, 1.2])
    whole, states = run(problem, settings)
    looks = [state for state in states if state.refinement]
    assert len(looks) == 5
    for state in (states[0], looks[0], looks[3], looks[4]):
        again, rest = run(problem, settings, state)
        assert_same_bits(again, whole)
        if state.refinement:
            assert all(later.refinement for later in rest)
            assert len(rest) - 1 == sum(
                len(s.refinement.chain.samples) > len(state.refinement.chain.samples) for s in looks
            )
