"""Cycles of a series that survive a kill: from the latest checkpoint on, in twin experiments and sequences of data."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from en4dvar.cycling.sequential import SequentialState
from en4dvar.runs.session import Session
from en4dvar.storage.checkpoint import Keeper, digest

Keep = Callable[[Callable[[], SequentialState]], None]


@contextmanager
def kept_cycles(run: Session, file: str, every: float, cycles: int) -> Iterator[tuple[SequentialState | None, Keep]]:
    """Where to resume from and what keeps the state after each cycle, in the checkpoint ``file``.

    What the block ends with is kept, too, so that it is never repeated.
    """
    fingerprint = digest("\n".join([run.identity.settings, *map(str, run.identity.data)]).encode())
    resume = None
    if run.resumed:
        resume = run.restore(file, fingerprint, SequentialState, "it is assimilated from the start")
    if resume is not None:
        run.log.write(f"continued after {resume.cycle} of {cycles} cycles")
    keeper = Keeper(run.directory.at(file), fingerprint, every)
    latest: list[Callable[[], SequentialState]] = []

    def keep(state: Callable[[], SequentialState]) -> None:
        latest[:] = [state]
        keeper.keep(state)

    yield resume, keep
    for state in latest:
        keeper.write(state())
