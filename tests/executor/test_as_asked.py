"""What a model's own ``trajectories`` return is what was asked for, or each member is lost for a reason its author can
act on.
"""

import numpy as np
import pytest
from toys import Vectorised

from en4dvar.executor import SerialExecutor, ThreadsExecutor, run_chunk
from en4dvar.model.forward import Batch, Failure, Shared, Trajectory
from en4dvar.series.window import MembersLost, propagate

TIMES = np.linspace(1.0, 60.0, 15)
LAYOUT = Vectorised("abc").layout


class Odd(Vectorised):
    """Its paths are ``make(x, times)``."""

    def __init__(self, make):
        super().__init__("abc")
        self.make = make

    def trajectories(self, x, times):
        return self.make(x, np.broadcast_to(times, (len(x), np.shape(times)[-1])))


def batch(x, times, columns=5, factor=1.0):
    return Batch(times, factor * np.ones((*times.shape, columns)), LAYOUT)


def listed(x, times, columns=5, factor=1.0):
    return [Trajectory(at, factor * np.ones((len(at), columns)), LAYOUT) for at in times]


GIVES, ASKED = "Odd.trajectories gives", "asked for 15 times from 1 to 60 s"
CASES = [
    (lambda x, t: batch(x, t - 1), f"{GIVES} 15 times from 0 to 59 s, {ASKED}"),
    (lambda x, t: listed(x, t - 1), f"{GIVES} 15 times from 0 to 59 s, {ASKED}"),
    (lambda x, t: batch(x, t[:, 1:]), f"{GIVES} 14 times from 5.21429 to 60 s, {ASKED}"),
    (lambda x, t: listed(x, t[:, 1:]), f"{GIVES} 14 times from 5.21429 to 60 s, {ASKED}"),
    (lambda x, t: batch(x, t[:, -1:]), f"{GIVES} 1 time from 60 to 60 s, {ASKED}"),
    (lambda x, t: batch(x, t[:, :0]), f"{GIVES} no times, {ASKED}"),
    (lambda x, t: listed(x, t[:, :0]), f"{GIVES} no times, {ASKED}"),
    (
        lambda x, t: batch(x, t + 0.5 * (np.arange(15) == 3)),
        f"{GIVES} 15 times from 1 to 60 s, {ASKED}; the first that differs is 14.1428571, not 13.6428571",
    ),
    (lambda x, t: batch(x, t * np.nan), f"{GIVES} 15 times from nan to nan s, {ASKED}"),
    (
        lambda x, t: np.ones((*t.shape, 5)),
        f"{GIVES} items of type ndarray; give a Batch, or a Trajectory or Failure for",
    ),
    (lambda x, t: None, "the model returned 0 trajectories for 1 members"),
    (
        lambda x, t: batch(x, t, columns=6),
        "states of shape (1, 15, 6) at times of shape (1, 15), where its layout has 5 numbers",
    ),
    (
        lambda x, t: listed(x, t, columns=6),
        "states of shape (15, 6) at times of shape (15,), where its layout has 5 numbers",
    ),
    (
        lambda x, t: Batch(t[:, 1:], np.ones((*t.shape, 5)), LAYOUT),
        "states of shape (1, 15, 5) at times of shape (1, 14)",
    ),
    (lambda x, t: batch(x, t, factor=1 + 1j), "the states of a path are complex numbers; give real ones"),
    (lambda x, t: listed(x, t, factor=1 + 1j), "the states of a path are complex numbers; give real ones"),
]


@pytest.mark.parametrize(("make", "reason"), CASES)
def test_what_was_not_asked_for_loses_the_members_with_a_reason(make, reason):
    outcomes = run_chunk(Odd(make), np.ones((4, 5)), TIMES)
    assert [reason in outcome.reason for outcome in outcomes if isinstance(outcome, Failure)] == [True] * 4, outcomes


def short(x, times):
    return [Trajectory(p.times[:k], p.states[:k], LAYOUT) for p, k in zip(listed(x, times), ends(x), strict=True)]


def ends(x):
    return np.where(x[:, 2] < 2, 15, 4)


def nan_times(x, times):
    return Batch(np.where(x[:, 2:3] < 2, times, np.nan), np.ones((*times.shape, 5)), LAYOUT)


def strange(x, times):
    return [path if k == 15 else path.states for path, k in zip(listed(x, times), ends(x), strict=True)]


@pytest.mark.parametrize("size", [1, 3, 64])
@pytest.mark.parametrize("make", [short, nan_times, strange])
def test_a_member_that_is_odd_is_lost_alone(make, size):
    """Without another run, whatever the batch; of threads that share the work, too."""
    calls = []

    class Counted(Odd):
        batch = size

        def trajectories(self, x, times):
            calls.append(len(x))
            return super().trajectories(x, times)

    class Sharing(Counted):
        def share(self, x, times):
            return Shared(lambda: None, lambda: self.trajectories(x, times))

    x = np.ones((4, 5))
    x[2, 2] = 3
    with ThreadsExecutor(2) as threads:
        each = run_chunk(Counted(make), x, TIMES), threads.trajectories(Sharing(make), x, TIMES)
    lost = [[isinstance(outcome, Failure) for outcome in outcomes] for outcomes in each]
    assert (lost, calls) == ([[False, False, True, False]] * 2, [4, 4])


@pytest.mark.parametrize("make", [batch, listed])
def test_times_that_are_those_asked_for_but_for_rounding_are_taken(make):
    """Single precision, and times of one member for all."""
    rounded = run_chunk(Odd(lambda x, t: make(x, t.astype(np.float32))), np.ones((4, 5)), TIMES)
    assert all(isinstance(outcome, Trajectory) for outcome in rounded)


@pytest.mark.parametrize("make", [batch, listed])
def test_a_model_may_hold_its_state_before_time_zero(make):
    """It says so by the times it gives: where readings are shifted in time, some are asked for before zero."""
    times = TIMES - 10
    held = run_chunk(Odd(lambda x, t: make(x, np.maximum(t, 0))), np.ones((4, 5)), times)
    late = run_chunk(Odd(lambda x, t: make(x, np.maximum(t, 5))), np.ones((4, 5)), times)
    assert [isinstance(outcome, Failure) for outcome in (*held, *late)] == [False] * 4 + [True] * 4


def test_a_batch_may_state_its_times_once():
    outcomes = run_chunk(Odd(lambda x, t: Batch(t[0], np.ones((*t.shape, 5)), LAYOUT)), np.ones((4, 5)), TIMES)
    assert isinstance(outcomes, Batch)
    np.testing.assert_array_equal(outcomes[1].times, TIMES)


def test_a_series_asks_for_times_on_the_models_clock():
    """A model that is resumed on its way gives the times since its own zero."""
    start = Vectorised().initial_state({"a": 1.0, "b": 0.5})
    whole = propagate(Vectorised(), start[None], 0.0, np.array([1.0, 2.0]), SerialExecutor())
    later = propagate(Vectorised(), whole[:, 0], 1.0, np.array([2.0]), SerialExecutor())
    np.testing.assert_allclose(later[:, 0], whole[:, 1], rtol=1e-12)


def test_a_resumed_that_gives_other_times_is_told_by_its_name():
    class Late(Vectorised):
        def resumed(self, x, start, times):
            return super().resumed(x, start, times - 0.5)

    with pytest.raises(MembersLost) as caught:
        propagate(Late(), np.ones((1, 4)), 1.0, np.array([2.0]), SerialExecutor())
    reason = "Late.resumed gives 1 time from 1.5 to 1.5 s, asked for 1 time from 2 to 2 s; the first that differs is"
    assert caught.value.reasons[0].startswith(reason)
