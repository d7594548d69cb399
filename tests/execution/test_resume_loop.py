"""The loop continues from any iteration to the same bits."""

import pytest
from same_bits import assert_same_bits
from toys import Decay, Wave, make_problem

from en4dvar.assimilate import assimilate
from en4dvar.problem import AssimilationSettings


@pytest.mark.parametrize("linearisation", ["bundle", "transform"])
def test_resumed_from_any_iteration(linearisation):
    settings = AssimilationSettings(members=9, linearisation=linearisation)
    for problem in (make_problem(Decay(), [1.5, 1.2], time_std=0.02), make_problem(Wave(), [1.0, 1.4])):
        states = []
        whole = assimilate(problem, settings, 3, on_iteration=states.append)
        assert len(states) == len(whole.iterations) > 3
        for state in states:
            rest = []
            again = assimilate(problem, settings, 3, resume=state, on_iteration=rest.append)
            assert_same_bits(again, whole)
            assert len(rest) == len(states) - len(state.records)  # nothing before the state is repeated
