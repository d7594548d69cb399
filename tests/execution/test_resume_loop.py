"""The loop continues from any iteration to the same bits."""

import pytest
from same_bits import assert_same_bits
from toys import Decay, Wave, make_problem

from en4dvar.assimilate import assimilate
from en4dvar.problem import AssimilationSettings


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
