"""The results that a study has computed so far, on disk, so that one that was killed continues to the same bits.

Kept are the chunks of the sweeps, the draws of each data set and the fits of one gel; what is quick, En4D-Var and the
populations, is computed again. What decides the numbers is kept with them, and a study is continued only where that
agrees.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypeVar

import yaml

from en4dvar.assembly.build import data_files, inverse_plan
from en4dvar.plumbing.errors import OutputError
from en4dvar.plumbing.files import inside, read_plain, refused, write_text
from en4dvar.results.checkpoint import FOLDER, CheckpointError, digest, read_checkpoint, write_checkpoint
from en4dvar.results.provenance import Identity, identity, source_digest
from en4dvar.runs.rundir import RunDirectory
from en4dvar_agarose.settings import StudyPlan

D = TypeVar("D")
IDENTITY = f"{FOLDER}/study"


class StudyCheckpoints:
    """Results of the study ``key`` in ``folder``."""

    def __init__(self, folder: Path, key: str):
        self.folder, self.key = folder, key

    @classmethod
    def open(cls, directory: RunDirectory, plan: StudyPlan, files: Sequence[str]) -> "StudyCheckpoints":
        """For a new study in ``directory``, which will write ``files``, or the one that is there.

        Raises
        ------
        OutputError: the one there would have other numbers; says what has changed. It cannot be written.
        """
        who = identity_of(plan)
        earlier = read_checkpoint(directory.at(IDENTITY), "study", Identity)
        if earlier is not None and (difference := who.difference(earlier, frozenset())):
            raise OutputError(
                f"{directory.path}: the study cannot be resumed to the same result, for this has changed:\n{difference}"
                "\ngive --force to compute everything again, or another --out"
            )
        directory.claim(*files)
        folder = directory.folder(FOLDER)
        write_checkpoint(directory.at(IDENTITY), "study", who)
        return cls(folder, digest(f"{who.settings}{who.data}".encode()))

    def sweep(self, *words: str) -> Path:
        """The folder of a sweep's chunks."""
        return prepare_folder(inside(self.folder, _file("sweep", *words)), self.key, "resume")

    def of(self, kind: type[D], compute: Callable[[], D], *words: str) -> D:
        """The dataclass kept under ``words``, or what ``compute`` gives, then kept."""
        path = inside(self.folder, _file(kind.__name__, *words))
        try:
            result = read_checkpoint(path, self.key, kind)
        except CheckpointError:  # damaged: computed again
            result = None
        if result is None:
            result = compute()
            write_checkpoint(path, self.key, result)
        return result


def identity_of(plan: StudyPlan) -> Identity:
    """The inputs that decide the numbers of a study: its effort and seed, its configurations, readings, software and
    sources.
    """
    settings: dict[str, Any] = {"seed": plan.seed, "sweep": asdict(plan.sweep)}
    common: dict[str, Any] = {"software": {}, "sources": {"en4dvar_agarose": source_digest("en4dvar_agarose")}}
    gels: dict[str, dict[str, Any]] = {}
    data: list[tuple[str, str]] = []
    for gel, models in plan.configs.items():
        gels[gel] = {}
        for model, config in models.items():
            own = identity(config.resolved, config.model, data_files(inverse_plan(config)))
            content = yaml.safe_load(own.settings)
            for key, values in common.items():
                values.update(content.pop(key))
            gels[gel][model] = content
            data += [(f"{gel}, {model}, {name}", digest) for name, digest in own.data]
    text = yaml.safe_dump({**settings, "gels": gels, **common}, sort_keys=False, allow_unicode=True, width=120)
    return Identity(text, tuple(data))


def _file(*words: str) -> str:
    return re.sub(r"[^A-Za-z0-9]+", "_", " ".join(words)).strip("_").lower()


def prepare_folder(folder: Path, key: str, mode: str) -> Path:
    """The folder of a sweep's chunks: ``new`` wants it empty, ``force`` empties it, ``resume`` wants the same ``key``.

    Raises
    ------
    OutputError: it holds another sweep, or cannot be written.
    """
    with refused(folder, "cannot be used"):
        folder.mkdir(parents=True, exist_ok=True)
        mark = inside(folder, "sweep.key")
        stored = read_plain(mark, 1000).decode("utf-8", "replace") if mark.exists() else ""
        if mode == "force":
            for file in (mark, *folder.glob("*.npz")):
                file.unlink(missing_ok=True)
            stored = ""
        if stored and mode == "new":
            raise OutputError(f"{folder}: holds a sweep; give --resume to continue it or --force to replace it")
        if stored and stored != key:
            raise OutputError(f"{folder}: holds the sweep of another configuration; give --force to replace it")
        for partial in folder.glob(".*.tmp"):  # of a process that was killed
            partial.unlink()
        write_text(mark, key)
    return folder
