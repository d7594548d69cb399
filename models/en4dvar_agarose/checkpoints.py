"""The results that a study or a sweep has computed so far, on disk, so that one that was killed continues to the same
bits.

Kept are the chunks of the sweeps, the draws of each data set and the fits of one gel; what is quick, En4D-Var and the
populations, is computed again. What decides the numbers is kept with them, and a study is continued only where that
agrees.
"""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypeVar

import yaml

from en4dvar.assembly.build import data_files, inverse_plan
from en4dvar.config import Config
from en4dvar.plumbing.errors import OutputError
from en4dvar.results.checkpoint import FOLDER, CheckpointError, digest, read_checkpoint, write_checkpoint
from en4dvar.results.fingerprint import Identity, identity, source_digest
from en4dvar.runs.engine import directory_mode
from en4dvar.runs.interrupt import tell_interrupt, terminate_as_interrupt
from en4dvar.runs.rundir import RunDirectory
from en4dvar.sampling.sweep import SweepSettings

D = TypeVar("D")
IDENTITY = f"{FOLDER}/study"


class StudyCheckpoints:
    """Results of the study ``key`` in ``directory``."""

    def __init__(self, directory: RunDirectory, key: str):
        self.directory, self.key = directory, key

    @classmethod
    @contextmanager
    def open(
        cls, folder: Path, force: bool, resume: bool, who: Identity, files: Sequence[str]
    ) -> "Iterator[StudyCheckpoints]":
        """For a new study in ``folder``, which will write ``files``, or the one that is there; complete as this ends.

        Raises
        ------
        OutputError: the one there would have other numbers; says what has changed. It cannot be written.
        """
        with (
            terminate_as_interrupt(),
            RunDirectory.open(folder, directory_mode(force, resume), files) as directory,
            tell_interrupt(lambda: f"finished parts are kept in {folder}"),
        ):
            earlier = read_checkpoint(directory.at(IDENTITY), "study", Identity)
            if earlier is not None and (difference := who.difference(earlier, frozenset())):
                raise OutputError(
                    f"{directory.path}: it cannot be resumed to the same result, for this has changed:\n{difference}"
                    "\ngive --force to compute everything again, or another --out"
                )
            directory.claim(*files)
            directory.folder(FOLDER)
            write_checkpoint(directory.at(IDENTITY), "study", who)
            yield cls(directory, digest(f"{who.settings}{who.data}".encode()))
            directory.publish()

    def sweep(self, *words: str) -> Path:
        """The folder of a sweep's chunks."""
        folder = self.directory.folder(f"{FOLDER}/{named('sweep', *words)}")
        for partial in folder.glob(".*.tmp"):  # of a process that was killed
            partial.unlink()
        return folder

    def of(self, kind: type[D], compute: Callable[[], D], *words: str) -> D:
        """The dataclass kept under ``words``, or what ``compute`` gives, then kept."""
        path = self.directory.at(f"{FOLDER}/{named(kind.__name__, *words)}")
        try:
            result = read_checkpoint(path, self.key, kind)
        except CheckpointError:  # damaged: computed again
            result = None
        if result is None:
            result = compute()
            write_checkpoint(path, self.key, result)
        return result


def identity_of(seed: int, sweep: SweepSettings, configs: Mapping[str, Config]) -> Identity:
    """What decides the numbers of a study: its seed and effort, its configurations by name, readings, software and
    sources.
    """
    common: dict[str, Any] = {"software": {}, "sources": {"en4dvar_agarose": source_digest("en4dvar_agarose")}}
    each: dict[str, dict[str, Any]] = {}
    data: list[tuple[str, str]] = []
    for name, config in configs.items():
        own = identity(config.resolved, config.model, data_files(inverse_plan(config)))
        each[name] = yaml.safe_load(own.settings)
        for key, values in common.items():
            values.update(each[name].pop(key))
        data += [(f"{name}, {dataset}", digest) for dataset, digest in own.data]
    settings = {"seed": seed, "sweep": asdict(sweep), "configurations": each, **common}
    return Identity(yaml.safe_dump(settings, sort_keys=False, allow_unicode=True, width=120), tuple(data))


def named(*words: str) -> str:
    """Words as part of a file's name."""
    return re.sub(r"[^A-Za-z0-9]+", "_", " ".join(words)).strip("_").lower()
