"""Members in chunks: the unit of work that is sent to a worker, and what many such units have in common."""

import functools
import itertools
import pickle
from collections.abc import Sequence
from typing import Any, Generic, TypeVar

import numpy as np

from en4dvar.executor.limits import TimeLimitError, has_time_limit, within_time_limit
from en4dvar.model.batch import Batch
from en4dvar.model.forward import Failure, ForwardModel, Trajectory
from en4dvar.model.state import Array
from en4dvar.plumbing.user_code import describe, reason_of

T = TypeVar("T")


class CommonValue(Generic[T]):
    """A value that is pickled once for all calls, and made again once in each worker process."""

    def __init__(self, value: T):
        self.value = value

    @functools.cached_property
    def _pickled(self) -> bytes:
        return pickle.dumps(self.value)

    def __reduce__(self) -> tuple[Any, ...]:
        return _made_again, (self._pickled,)


@functools.lru_cache(maxsize=2)
def _made_again(pickled: bytes) -> CommonValue[Any]:
    return CommonValue(pickle.loads(pickled))


Outcome = Trajectory | Failure


def cut(n_members: int, batch: int, workers: int) -> list[slice]:
    """Contiguous chunks of members, at most one per worker, each but the last a multiple of ``batch``.

    >>> cut(10, 4, 2)
    [slice(0, 8, None), slice(8, 10, None)]
    """
    batches = -(-n_members // batch)
    edges = [min(n_members, batch * -(-batches * i // min(workers, batches))) for i in range(min(workers, batches) + 1)]
    return [slice(a, b) for a, b in itertools.pairwise(edges)]


def run_chunk(model: ForwardModel, x: Array, times: Array) -> Sequence[Outcome]:
    """Run a chunk; where the model raises, run its batches one by one, so that only a raising batch is lost.

    Where batches are timed (see :mod:`en4dvar.executor.limits`) they are run one by one from the start.
    """
    if has_time_limit() and len(x) > model.batch:
        return _by_batch(model, x, times)
    try:
        with without_warnings():
            outcomes = within_time_limit(lambda: kept(model.trajectories(x, times)))
        reason = f"the model returned {len(outcomes)} trajectories for {len(x)} members"
    except TimeLimitError as error:
        outcomes, reason = [], describe(error)
    except BaseException as error:  # a model may fail in any way; the reason is kept
        outcomes, reason = [], reason_of(error)
    if len(outcomes) == len(x):
        return outcomes
    if len(x) <= model.batch:
        return [Failure(reason)] * len(x)
    return _by_batch(model, x, times)


def _by_batch(model: ForwardModel, x: Array, times: Array) -> list[Outcome]:
    times = np.broadcast_to(times, (len(x), np.shape(times)[-1]))
    parts = [slice(i, i + model.batch) for i in range(0, len(x), model.batch)]
    return [outcome for part in parts for outcome in run_chunk(model, x[part], times[part])]


def kept(outcomes: Sequence[Outcome]) -> Sequence[Outcome]:
    """A batch as it is, anything else as a list."""
    return outcomes if isinstance(outcomes, Batch) else list(outcomes)


def without_warnings() -> np.errstate:
    """Within, numpy does not warn of an overflow, say: a member that it spoils fails, and says so itself.

    What a model sets is for the model alone.
    """
    quiet: dict[str, Any] = {kind: "ignore" for kind, told in np.geterr().items() if told == "warn"}
    return np.errstate(**quiet)
