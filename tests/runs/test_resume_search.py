"""A dear model whose run is killed in its later descents: what was run is not run again."""

import os
import signal

import pytest
from cut_anywhere import kept_runs
from same_bits import assert_same_bits
from toys import Counted
from wells import UnlikeWells, two_wells

from en4dvar.diagnosis.analysis import StartRecord
from en4dvar.estimation.assimilate import assimilate
from en4dvar.executor import SerialExecutor
from en4dvar.results.checkpoint import Journal, Keeper, KnownRuns, read_checkpoint
from en4dvar.schemes.settings import AssimilationSettings

SETTINGS, SEED = AssimilationSettings(start="prior-mean"), 3


class Counting(Counted, UnlikeWells):
    pass


def problem():
    return two_wells(Counting, compiled=False, mean=-0.3, seed=SEED)


def killed(path, further):
    """The runs that a process has kept that was killed at the first move of a round of the search."""

    def die(_, record):
        if isinstance(record, StartRecord) and record.further == further:
            os.kill(os.getpid(), signal.SIGKILL)

    child = os.fork()
    if child == 0:
        assimilate(problem(), SETTINGS, SEED, Journal(SerialExecutor(), keeper=Keeper(path, "run", 0.0)), die)
        os._exit(0)
    assert os.waitpid(child, 0)[1] == signal.SIGKILL
    return read_checkpoint(path, "run", KnownRuns)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork")
@pytest.mark.parametrize("further", [1, 2, 5])
def test_killed_in_a_later_descent(tmp_path, further):
    first, other = problem(), problem()
    whole = assimilate(first, SETTINGS, SEED)
    known = killed(tmp_path / "set.iteration", further)
    assert_same_bits(assimilate(other, SETTINGS, SEED, Journal(SerialExecutor(), known)), whole)
    assert known.forecasts
    assert other.model.runs == first.model.runs - sum(map(len, known.forecasts))


def test_nothing_is_told_twice():
    """What hears of rounds and iterations hears, after an interruption, of those that were not told before."""
    _, runs = kept_runs(problem(), SETTINGS, SEED)
    every, later = [], []
    assimilate(problem(), SETTINGS, SEED, progress=lambda _, record: every.append(record))
    known = KnownRuns(runs.keys[:20], runs.forecasts[:20])
    journal = Journal(SerialExecutor(), known)
    assimilate(problem(), SETTINGS, SEED, journal, journal.untold(lambda _, record: later.append(record)))
    assert 0 < len(later) < len(every)
    assert [type(record) for record in later] == [type(record) for record in every[-len(later) :]]
