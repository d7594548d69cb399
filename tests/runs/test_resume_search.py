"""A dear model whose run is killed in its later descents: what has ended is not descended again."""

import os
import signal

import pytest
from same_bits import assert_same_bits
from wells import UnlikeWells, two_wells

from en4dvar.diagnosis.analysis import StartRecord
from en4dvar.estimation.assimilate import LoopState, assimilate
from en4dvar.results.checkpoint import Keeper, read_checkpoint
from en4dvar.schemes.settings import AssimilationSettings

SETTINGS, SEED = AssimilationSettings(start="prior-mean"), 3


class Counting(UnlikeWells):
    runs = 0

    def trajectories(self, x, times):
        self.runs += len(x)
        return super().trajectories(x, times)


def problem():
    return two_wells(Counting, compiled=False, mean=-0.3, seed=SEED)


def killed(path, further):
    """What a process has left that was killed at the first move of a round of the search."""

    def die(_, record):
        if isinstance(record, StartRecord) and record.further == further:
            os.kill(os.getpid(), signal.SIGKILL)

    child = os.fork()
    if child == 0:
        keeper = Keeper(path, "run", 0.0)
        assimilate(problem(), SETTINGS, SEED, progress=die, keep=keeper.keep)
        os._exit(0)
    assert os.waitpid(child, 0)[1] == signal.SIGKILL
    return read_checkpoint(path, "run", LoopState)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork")
@pytest.mark.parametrize("further", [1, 2, 5])
def test_killed_in_a_later_descent(tmp_path, further):
    whole = assimilate(problem(), SETTINGS, SEED)
    state = killed(tmp_path / "set.iteration", further)
    assert state.search.over == further - 1
    assert state.search.comparison is not None
    other = problem()
    again = assimilate(other, SETTINGS, SEED, resume=state)
    assert_same_bits(again, whole)
    left, prior, linearised = whole.forward_runs - state.forward_runs, 48 + 1 + 2, 3
    assert other.model.runs == left + prior + linearised
