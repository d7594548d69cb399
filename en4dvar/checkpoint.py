"""Checkpoints: what an interrupted run needs to continue to the same bits.

``checkpoints/run.yaml`` says what was computed (resolved configuration, sources, data); ``<data set>.iteration`` holds
the state of the loop (weights, transform, records with the members alive) at the start of the latest iteration, and
``<data set>.done`` that and how the data set ended. The prior ensemble is drawn again from the seed, whose streams are
counter-based, so no state of a random generator is lost.

Every file starts with one line: format, version, kind, fingerprint of the run and the data set, and the SHA-256 of the
rest. A file that was cut short, altered, or written by another run is named and not used.
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import TypeVar

from en4dvar.codec import decode, encode
from en4dvar.errors import OutputError
from en4dvar.files import atomic_path

D = TypeVar("D")
FORMAT = "en4dvar-checkpoint"
VERSION = "1"
FOLDER = "checkpoints"


class CheckpointError(OutputError):
    """A checkpoint that cannot be used, and why; the message starts with its path."""


def write_checkpoint(path: Path, fingerprint: str, content: object, durable: bool = True) -> None:
    """Write a dataclass; it appears complete or not at all. ``durable``: also after a loss of power.

    Raises
    ------
    OutputError: the file cannot be written.
    """
    payload = encode(content)
    head = " ".join((FORMAT, VERSION, type(content).__name__, fingerprint, digest(payload)))
    with atomic_path(path, durable) as partial:
        partial.write_bytes(f"{head}\n".encode("ascii") + payload)


def read_checkpoint(path: Path, fingerprint: str, kind: type[D]) -> D | None:
    """The dataclass in ``path``, or None where there is no such file.

    Raises
    ------
    CheckpointError: the file is not a checkpoint, incomplete, altered, or of another version, run or kind.
    """
    try:
        head, _, payload = path.read_bytes().partition(b"\n")
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
    try:
        return decode(payload, kind)
    except ValueError as error:
        raise CheckpointError(f"{path}: {error}") from None


def digest(content: bytes) -> str:
    """SHA-256 in hexadecimal."""
    return hashlib.sha256(content).hexdigest()


def file_digest(path: Path) -> str:
    """SHA-256 of a file, or "" where it cannot be read."""
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError:
        return ""
