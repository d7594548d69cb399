"""The numbers do not depend on where members run."""

import subprocess
import sys
import threading
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from same_bits import assert_same_bits
from toys import Decay, Dying, Fragile, Vectorised, make_problem

from en4dvar.estimation.assimilate import assimilate
from en4dvar.executor import ProcessesExecutor, SerialExecutor, ThreadsExecutor, choose_executor, cut
from en4dvar.model.forward import Failure
from en4dvar.plumbing import children
from en4dvar.plumbing.children import HaltedError, end_those_of, starts_again
from en4dvar.results.checkpoint import Journal
from en4dvar.schemes.settings import AssimilationSettings
from en4dvar_bubble import BubbleModel
from en4dvar_bubble.laws import get_law
from en4dvar_bubble.medium import WATER_25C

SETTINGS = AssimilationSettings(members=13)


def problems():
    return (
        make_problem(Decay(), [1.5, 1.2], time_std=0.02),
        make_problem(Vectorised(("a", "b", "c"), batch=4, compiled=True), [1.0, 0.5, 0.2]),
        make_problem(Fragile(1.6, how="raise", names=("a", "b")), [1.0, 0.5]),
    )


@pytest.mark.parametrize(
    ("kind", "workers"),
    [
        (ThreadsExecutor, 1),
        (ThreadsExecutor, 2),
        (ProcessesExecutor, 2),
        *(
            pytest.param(*case, marks=pytest.mark.slow)
            for case in [(ProcessesExecutor, 1), (ThreadsExecutor, 3), (ProcessesExecutor, 3)]
        ),
    ],
)
def test_same_bits_for_any_executor(kind, workers):
    with kind(workers) as executor:
        for problem in problems():
            serial = assimilate(problem, SETTINGS, 3)
            assert_same_bits(assimilate(problem, SETTINGS, 3, executor), serial)


def test_seed_decides():
    problem = problems()[0]
    assert_same_bits(assimilate(problem, SETTINGS, 3), assimilate(problem, SETTINGS, 3, SerialExecutor()))
    assert not np.array_equal(assimilate(problem, SETTINGS, 4).prior, assimilate(problem, SETTINGS, 3).prior)


@pytest.mark.parametrize("kind", [ThreadsExecutor, ProcessesExecutor])
def test_exception_fails_only_the_batch_that_raised(kind):
    model = Fragile(0.0, how="raise", names=("a", "b"), batch=2)
    x = np.array([model.initial_state({"a": a, "b": 1.0}) for a in (-1, -1, -1, 1, -1, -1, -1)])
    times = np.array([0.1, 0.2])
    expected = [False, False, True, True, False, False, False]
    for executor in (SerialExecutor(), kind(2)):
        with executor:
            results = executor.trajectories(model, x, times)
        assert [isinstance(r, Failure) for r in results] == expected
        assert results[2].reason == "FloatingPointError: overflow"
        assert np.array_equal(results[4].states[0], model.step(x[4], 0.0, 0.1))


@pytest.mark.filterwarnings("always")
@pytest.mark.parametrize("kind", [SerialExecutor, lambda: ThreadsExecutor(2)])
def test_a_member_that_numpy_would_warn_of_fails_in_silence(kind, recwarn):
    """With so little gas its pressure is lost beside that of the vapour."""
    medium = replace(WATER_25C, p_v=3169.0)
    model = BubbleModel(get_law("neo-hookean-kelvin-voigt"), start="laser", medium=medium)
    values = {"G": 4e3, "mu": 0.1, "R_max": 3e-4}
    theta = {"R_eq": np.array([3e-12, 5e-5]), **{name: np.full(2, value) for name, value in values.items()}}
    with kind() as executor:
        results = executor.trajectories(model, model.initial_states(theta), np.array([1e-6]))
    assert [isinstance(r, Failure) for r in results] == [True, False]
    assert not recwarn.list


@pytest.mark.slow
def test_death_of_a_worker_is_a_failure_and_the_pool_recovers():
    model = Dying()
    good = np.tile(model.initial_state({"a": 1.0, "b": 1.0}), (4, 1))
    bad = good.copy()
    bad[:, 2] = -1.0
    with ProcessesExecutor(1) as executor:
        assert [r.reason for r in executor.trajectories(model, bad, np.array([0.1]))] == ["a worker process died"] * 4
        assert not any(isinstance(r, Failure) for r in executor.trajectories(model, good, np.array([0.1])))


@pytest.mark.parametrize("batch", [1, 3, 8])
@pytest.mark.parametrize("workers", [1, 2, 5, 40])
def test_chunks_cover_members_and_respect_batches(batch, workers):
    for n in range(1, 30):
        chunks = cut(n, batch, workers)
        assert [i for part in chunks for i in range(n)[part]] == list(range(n))
        assert len(chunks) <= workers
        assert all(part.start % batch == 0 and part.stop > part.start for part in chunks)


def test_the_executor_is_chosen_by_the_model():
    assert isinstance(choose_executor(Decay(), workers=1), SerialExecutor)
    assert isinstance(choose_executor(Decay(compiled=True), workers=2), ThreadsExecutor)
    assert isinstance(choose_executor(Decay(), workers=2), ProcessesExecutor)
    with pytest.raises(ValueError, match="at least 1"):
        ThreadsExecutor(0)


def test_a_worker_whose_main_process_is_gone_as_it_starts_says_nothing():
    code = (
        "from multiprocessing import Pipe; from en4dvar.executor.limits import NO_LIMITS; "
        "from en4dvar.executor.processes import _serve; "
        "ours, theirs = Pipe(); ours.close(); _serve(theirs, NO_LIMITS, '.')"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")


def test_a_thread_that_is_to_stop_makes_no_further_forecast():
    """Whatever its code does with an exception that is raised in it."""
    me, journal = [threading.get_ident()], Journal(SerialExecutor())
    assert journal.once(lambda: 1) == 1
    end_those_of(me)
    try:
        with pytest.raises(HaltedError):
            journal.once(lambda: 1)
    finally:
        starts_again(me)


def test_threads_of_a_run_are_not_stopped_by_numbers_that_an_earlier_run_has_left(monkeypatch):
    """A thread that was in compiled code as Ctrl-C came ends later; the system gives its number again."""

    class Every(set[int]):
        def __contains__(self, number: object) -> bool:
            return not super().__contains__(number)

        def difference_update(self, *numbers: Any) -> None:
            self.update(*numbers)

    monkeypatch.setattr(children, "_stopped", Every())
    with ThreadsExecutor(1) as executor:
        assert list(executor.map(Journal(SerialExecutor()).once, [(int,)])) == [(0, 0)]
