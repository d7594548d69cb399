"""Estimates that are interrupted after any number of forecasts, and go on from what their journal has kept."""

from pathlib import Path

from same_bits import assert_same_bits

from en4dvar.estimation.assimilate import assimilate
from en4dvar.executor import SerialExecutor
from en4dvar.results.checkpoint import Journal, KnownRuns, decode, encode


class Memory:
    """Keeps in memory what a file would hold."""

    path, runs = Path(__file__), KnownRuns()

    def keep(self, state):
        self.runs = state()


class Counted(Journal):
    """Counts the forecasts that are made."""

    made = 0

    def once(self, run, *asked):
        def counted(*asked):
            self.made += 1
            return run(*asked)

        return super().once(counted, *asked)


def kept_runs(problem, settings, seed):
    """The analysis and all forward runs that it took, as they come back from a file."""
    memory = Memory()
    whole = assimilate(problem, settings, seed, Journal(SerialExecutor(), keeper=memory))
    return whole, decode(encode(memory.runs), KnownRuns)


def gone_on(problem, settings, seed, runs, count):
    """The analysis after ``count`` of its forecasts were kept, and how many more it made."""
    journal = Counted(SerialExecutor(), KnownRuns(runs.keys[:count], runs.forecasts[:count]))
    return assimilate(problem, settings, seed, journal), journal.made


def assert_cut_anywhere(problem, settings, seed, cuts=None):
    """Cut after each forecast, or ``cuts`` times at even distances: the same bits, and nothing is run twice."""
    whole, runs = kept_runs(problem, settings, seed)
    assert_same_bits(whole, assimilate(problem, settings, seed))
    last = len(runs.keys)
    assert last > 3
    for count in range(last + 1) if cuts is None else {round(last * i / (cuts - 1)) for i in range(cuts)}:
        again, made = gone_on(problem, settings, seed, runs, count)
        assert_same_bits(again, whole)
        assert made == last - count
    return whole
