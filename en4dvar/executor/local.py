"""Executors within this process: itself, and threads."""

import functools
from collections.abc import Callable, Iterable, Iterator, Sequence

from en4dvar.executor.base import Call, Executor, Hear, T
from en4dvar.executor.chunks import Outcome, kept, run_chunk
from en4dvar.executor.futures import PoolExecutor
from en4dvar.model.forward import ForwardModel
from en4dvar.model.state import Array
from en4dvar.plumbing.user_code import own_fault


class SerialExecutor(Executor):
    """Everything in this process, one call after the other."""

    def map(
        self, function: Callable[..., T], calls: Iterable[Call], hear: Hear | None = None
    ) -> Iterator[tuple[int, T | Exception]]:
        for i, call in enumerate(calls):
            try:
                value: T | Exception = function(*call, *([functools.partial(hear, i)] if hear else []))
            except BaseException as error:
                value = own_fault(error)
            yield i, value

    def trajectories(self, model: ForwardModel, x: Array, times: Array) -> Sequence[Outcome]:
        """The trajectories as they come from the model: nothing is cut, nothing is collected."""
        return run_chunk(model, x, times)

    def close(self) -> None:
        """Nothing to release."""


class ThreadsExecutor(PoolExecutor):
    """Threads of this process, for models whose ``trajectories`` release the interpreter lock (``compiled``)."""

    def trajectories(self, model: ForwardModel, x: Array, times: Array) -> Sequence[Outcome]:
        """As of any executor; a model that can share a batch among threads is prepared once, in the calling thread.

        A forecast takes 1 ms: threads that contend for the interpreter, and one more to wake, would be a third of it.
        """
        try:
            shared = model.share(x, times)
            if shared is None:
                return super().trajectories(model, x, times)
            helpers = min(self.workers, -(-len(x) // model.batch)) - 1
            futures = [self._submit(shared.work, (), None) for _ in range(helpers)]
            shared.work()
            for future in futures:
                future.result()
            results = kept(shared.results())
        except BaseException as error:  # told member by member
            own_fault(error)
            results = []
        return results if len(results) == len(x) else super().trajectories(model, x, times)
