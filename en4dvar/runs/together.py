"""Estimates of all data sets of a run together, at its end: made once of the same single estimates."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from en4dvar.runs.finished import Finished, finished_set
from en4dvar.runs.worklist import Worklist
from en4dvar.storage.checkpoint import FOLDER, digest, file_digest, write_checkpoint
from en4dvar.storage.store import load_stored

Estimated = Callable[[Sequence[Finished], Mapping[str, Any], Path, Callable[[str], None]], object]


def checkpoint_of(file: str) -> str:
    """The record of what an estimate in ``file`` was made of."""
    return f"{FOLDER}/{Path(file).stem}"


def once_together(work: Worklist, file: str, what: str, fewest: int, estimate: Estimated) -> None:
    """Write ``file`` in the run's directory by ``estimate(sets, attributes, path, tell)``, with the data sets that have
    a posterior; fewer than ``fewest`` are told. A file that a resumed run finds, made of the same, is kept.

    Raises what ``estimate`` does, and :class:`OutputError`.
    """
    config, run = work.config, work.run
    good = work.good()
    if len(good) < fewest:
        run.notice(f"no {what}, for which {fewest} data sets need a posterior")
        return
    digests = (f"{d.name}: {work.pack.entries[d.stem].content_digest}" for d in good)
    made_of = [run.identity.settings, *digests]
    fingerprint, path = digest("\n".join(made_of).encode()), run.directory.at(file)
    done = run.restore(checkpoint_of(file), fingerprint, str, f"the {what} is made again")
    if done is not None and path.exists() and file_digest(path) == done:
        return
    sets = [finished_set(config, load_stored(run.directory.work / d.file), run.directory.path) for d in good]
    attributes = {**run.attributes, "identity": run.identity.settings, "runs": config.name}
    estimate(sets, attributes, path, lambda words: run.log.write(f"{what}: {words}"))
    write_checkpoint(run.directory.at(checkpoint_of(file)), fingerprint, file_digest(path))
