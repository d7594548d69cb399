"""Checkpoints: what an interrupted run needs to continue to the same bits.

``checkpoints/run.yaml`` says what was computed (resolved configuration, sources, data); ``<data set>.iteration`` holds
the state of the loop before the latest iteration (weights, transform, records with the members alive), or the same of
each descent while a start is looked for, and under ``refine: mcmc`` the chain so far with the state of its random
numbers; ``<data set>.done`` that and how the data set ended. ``twin.cycle`` holds the same of a twin experiment. Prior
ensembles, perturbations and rotations are drawn again from the seed: their streams are counter-based and have no state.

Every file starts with one line: format, version, kind, fingerprint of the run and the data set, and the SHA-256 of the
rest. A file that was cut short, altered, or written by another run is named and not used.
"""

import hashlib
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, TypeVar

from en4dvar.plumbing.errors import OutputError, retold
from en4dvar.plumbing.files import atomic_path, open_plain, read_at_most
from en4dvar.results.codec import decode, encode

D = TypeVar("D")
FORMAT = "en4dvar-checkpoint"
VERSION = "3"
LONGEST = 64_000_000_000  # bytes of a checkpoint
FOLDER = "checkpoints"


class CheckpointError(OutputError):
    """A checkpoint that cannot be used, and why; the message starts with its path."""


def write_checkpoint(path: Path, fingerprint: str, content: object) -> None:
    """Write a dataclass; it appears complete or not at all, also after a loss of power.

    Raises
    ------
    OutputError: the file cannot be written.
    """
    payload = encode(content)
    head = " ".join((FORMAT, VERSION, type(content).__name__, fingerprint, digest(payload)))
    with atomic_path(path) as partial:
        partial.write_bytes(f"{head}\n".encode("ascii") + payload)


@dataclass
class Keeper:
    """Keeps the latest state of a computation in a file, flushed to the disk: neither a kill nor a loss of power takes
    more than what was done since.

    A state is written at most every ``every`` seconds, and so seldom that writing takes a twentieth of the time; with
    ``every`` 0 each one is.
    """

    path: Path
    fingerprint: str
    every: float
    _next: float | None = None  # on this machine's clock, so that it is set where states are kept

    SHARE: ClassVar[float] = 0.05

    def keep(self, state: Callable[[], object]) -> None:
        """Write what ``state`` gives where the time has come. Raises :class:`OutputError`."""
        if self._next is None:
            self._next = time.monotonic() + self.every
        if time.monotonic() >= self._next:
            self.write(state())

    def write(self, state: object) -> None:
        """Write a state at once. Raises :class:`OutputError`."""
        began = time.monotonic()
        write_checkpoint(self.path, self.fingerprint, state)
        now = time.monotonic()
        self._next = now + (max(self.every, (now - began) / self.SHARE) if self.every else 0.0)


def read_checkpoint(path: Path, fingerprint: str, kind: type[D]) -> D | None:
    """The dataclass in ``path``, or None where there is no such file.

    Raises
    ------
    CheckpointError: the file is not a checkpoint, incomplete, altered, or of another version, run or kind.
    """
    try:
        with open_plain(path) as file:
            head, _, payload = read_at_most(file, LONGEST).partition(b"\n")
    except FileNotFoundError:
        return None
    except OSError as error:
        raise CheckpointError(f"{path}: cannot be read: {error.strerror}") from None
    words = head.decode("ascii", "replace").split(" ")
    if words[0] != FORMAT or len(words) < 2:
        raise CheckpointError(f"{path}: not a checkpoint of en4dvar")
    if words[1] != VERSION:
        raise CheckpointError(f"{path}: checkpoint format {words[1]}; this version reads {VERSION}")
    if len(words) != 5 or digest(payload) != words[4]:
        raise CheckpointError(f"{path}: damaged or incomplete (its checksum does not match)")
    if words[3] != fingerprint:
        raise CheckpointError(f"{path}: belongs to another run (other configuration, data or model)")
    if words[2] != kind.__name__:
        raise CheckpointError(f"{path}: holds a {words[2]}, not a {kind.__name__}")
    with retold(ValueError, CheckpointError, f"{path}: "):
        return decode(payload, kind)


def digest(content: bytes) -> str:
    """SHA-256 in hexadecimal."""
    return hashlib.sha256(content).hexdigest()


def file_digest(path: Path) -> str:
    """SHA-256 of a file, or "" where it cannot be read."""
    try:
        with open_plain(path) as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError:
        return ""
