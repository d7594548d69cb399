"""The loop continues from any iteration to the same bits."""

import pytest
from same_bits import assert_same_bits
from toys import Decay, Wave, make_problem

from en4dvar.assimilate import LoopState, assimilate
from en4dvar.problem import AssimilationSettings
from en4dvar.sampling import mcmc
from en4dvar.storage.codec import decode, encode


@pytest.mark.parametrize("starts", [1, 2])
@pytest.mark.parametrize("linearisation", ["bundle", "transform"])
def test_resumed_from_any_iteration(linearisation, starts):
    settings = AssimilationSettings(members=9, linearisation=linearisation, starts=starts)
    for problem in (make_problem(Decay(), [1.5, 1.2], time_std=0.02), make_problem(Wave(), [1.0, 1.4])):
        states = []
        whole = assimilate(problem, settings, 3, on_iteration=states.append)
        # the moves of the start that was chosen are the first iterations, and part of the first state
        before = len(states[0].records)
        assert len(states) == len(whole.iterations) - before >= 1
        assert (before > 0) == (starts > 1 and linearisation == "bundle")
        assert len(whole.iterations) > 3
        for state in states:
            rest = []
            again = assimilate(problem, settings, 3, resume=state, on_iteration=rest.append)
            assert_same_bits(again, whole)
            assert len(rest) == len(whole.iterations) - len(state.records)  # nothing before the state is repeated


@pytest.mark.parametrize("scheme", ["en4dvar", "es-mda"])
def test_refinement_resumed_from_any_look_at_the_chain(scheme, monkeypatch):
    """The chain goes on where it was, with the same draws; its runs are not repeated and still counted."""
    monkeypatch.setattr(mcmc.sample, "__kwdefaults__", {**mcmc.sample.__kwdefaults__, "max_steps": 210})
    settings = AssimilationSettings(scheme=scheme, members=9, refine="mcmc")
    problem = make_problem(Decay(), [1.5, 1.2])
    states = []
    whole = assimilate(problem, settings, 3, on_iteration=states.append)
    looks = [state for state in states if state.refinement]
    assert len(looks) == 5
    for state in (states[0], looks[0], looks[3], looks[4]):
        saved = decode(encode(state), LoopState)  # as it comes back from a file
        rest = []
        assert_same_bits(assimilate(problem, settings, 3, resume=saved, on_iteration=rest.append), whole)
        if state.refinement:
            assert all(later.refinement for later in rest)
            assert len(rest) - 1 == sum(
                len(s.refinement.chain.samples) > len(state.refinement.chain.samples) for s in looks
            )
