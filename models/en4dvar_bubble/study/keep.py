"""What a study has computed so far, on disk, so that one that was killed continues to the same bits.

Kept are the chunks of the sweeps, the populations and the fits of one gel; En4D-Var is quick and computed again.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from en4dvar.inputs.build import build
from en4dvar.storage.checkpoint import CheckpointError, read_checkpoint, write_checkpoint
from en4dvar_bubble.study.settings import StudyPlan
from en4dvar_bubble.study.sweep import prepare_folder

D = TypeVar("D")
FOLDER = "checkpoints"


class Keep:
    """Results of the study ``key`` in ``folder``."""

    def __init__(self, folder: Path, key: str):
        self.folder, self.key = folder, key
        folder.mkdir(parents=True, exist_ok=True)

    def sweep(self, *words: str) -> Path:
        """The folder of a sweep's chunks; those of another study are removed."""
        folder = self.folder / _file("sweep", *words)
        stored = folder / "sweep.key"
        same = stored.exists() and stored.read_text(encoding="utf-8") == self.key
        return prepare_folder(folder, self.key, "resume" if same else "force")

    def of(self, kind: type[D], compute: Callable[[], D], *words: str) -> D:
        """The dataclass kept under ``words``, or what ``compute`` gives, then kept."""
        path = self.folder / _file(kind.__name__, *words)
        try:
            found = read_checkpoint(path, self.key, kind)
        except CheckpointError:  # of another study, or damaged: computed again
            found = None
        if found is None:
            found = compute()
            write_checkpoint(path, self.key, found)
        return found


def key_of(plan: StudyPlan) -> str:
    """What a study depends on: its file, its configurations as resolved, the readings."""
    digest = hashlib.sha256(f"{plan.text}{plan.sweep}{plan.population}".encode())
    for gel, models in plan.configs.items():
        for model, config in models.items():
            digest.update(f"{gel}{model}{config.resolved}".encode())
            for problem in build(config):
                digest.update(problem.observations.times.tobytes() + problem.observations.values.tobytes())
    return digest.hexdigest()


def _file(*words: str) -> str:
    return re.sub(r"[^A-Za-z0-9]+", "_", " ".join(words)).strip("_").lower()
