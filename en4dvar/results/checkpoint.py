"""Checkpoints: what an interrupted run needs to continue to the same bits.

Prior ensembles, perturbations and rotations are not among it: they are drawn again from the seed.

Every file starts with one line: format, version, kind, fingerprint of the run and the data set, and the SHA-256 of the
rest. A file that was cut short, altered, or written by another run is named and not used. It holds frozen dataclasses
of numbers, text and arrays: one JSON text, which says of each array its kind, its shape, its order and where it begins,
and after it the numbers of all arrays. What is read back is checked against the annotations of the dataclass. Nothing
that is read is executed (no pickle).
"""

import functools
import hashlib
import json
import math
import struct
import time
from collections.abc import Callable
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal, TypeVar, cast

import numpy as np
from pydantic import ConfigDict, TypeAdapter

from en4dvar.diagnosis.analysis import Progress
from en4dvar.ensemble.forecast import Forecast
from en4dvar.executor import Executor
from en4dvar.model.state import Array
from en4dvar.plumbing.children import require_going_on
from en4dvar.plumbing.errors import OutputError, retold
from en4dvar.plumbing.files import atomic_path, open_plain, read_at_most

D = TypeVar("D")
FORMAT = "en4dvar-checkpoint"
VERSION = "4"
LONGEST = 64_000_000_000  # bytes of a checkpoint
FOLDER = "checkpoints"
ARRAY = ""  # in place of the name of a field: what follows says where an array is
_HEAD = struct.Struct("<cQ")  # before what holds numbers of arrays: the letter A and the size of the text


class CheckpointError(OutputError):
    """A checkpoint that cannot be used, and why; the message starts with its path."""


def write_checkpoint(path: Path, fingerprint: str, content: object) -> None:
    """Write a dataclass, all of it or nothing, also after a loss of power. Raises :class:`OutputError`."""
    payload = encode(content)
    head = " ".join((FORMAT, VERSION, type(content).__name__, fingerprint, digest(payload)))
    with atomic_path(path) as partial:
        partial.write_bytes(f"{head}\n".encode("ascii") + payload)


@dataclass
class Keeper:
    """Keeps the latest state of a computation in a file, flushed to the disk: neither a kill nor a loss of power takes
    more than what was done since. It is written at most every ``every`` seconds, and so seldom that writing takes a
    twentieth of the time; with ``every`` 0 each one is.
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
    """The dataclass in ``path``, None without a file. Raises :class:`CheckpointError`: it cannot be used, and why."""
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


# Dataclasses ⇄ bytes


def encode(value: Any) -> bytes:
    """Bytes of a float, int, bool, str, None, an array of floats, or of a tuple or dataclass of these."""
    numbers = bytearray()
    text = json.dumps(_plain(value, numbers)).encode("ascii")  # repr of a float is exact; NaN and Infinity are kept
    return b"".join((_HEAD.pack(b"A", len(text)), text, numbers)) if numbers else text


def decode(content: bytes, kind: type[D]) -> D:
    """What :func:`encode` was given. Raises :class:`ValueError`: it is not of ``kind``."""
    with retold((KeyError, TypeError, ValueError, struct.error), ValueError, f"not a {kind.__name__}: "):
        text, numbers = content, bytearray()
        if content.startswith(b"A"):
            end = _HEAD.size + _HEAD.unpack_from(content)[1]
            text, numbers = content[_HEAD.size : end], bytearray(content[end:])
        plain = json.loads(text, object_hook=lambda raw: _array(raw, numbers))
        value: D = _checked(cast(Any, kind)).validate_python([plain])[0]
    return value


def _plain(value: Any, numbers: bytearray) -> Any:
    if is_dataclass(value):
        return {f.name: _plain(getattr(value, f.name), numbers) for f in fields(value)}
    if isinstance(value, np.ndarray):
        order: Literal["F", "C"] = "F" if value.flags.fnc else "C"  # another order: other sums
        told = [value.dtype.str, value.shape, order, len(numbers)]
        numbers += value.tobytes(order)
        return {ARRAY: told}
    if isinstance(value, tuple):
        return [_plain(item, numbers) for item in value]
    if isinstance(value, np.generic):
        return value.item()
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise TypeError(f"cannot store a {type(value).__name__}")


@functools.cache  # a campaign reads as many of a kind as it has data sets
def _checked(kind: Any) -> TypeAdapter[Any]:
    """What compares with the annotations; inside of a tuple, for a dataclass takes no configuration itself."""
    return TypeAdapter(tuple[kind], config=ConfigDict(arbitrary_types_allowed=True, extra="forbid"))


def _array(raw: Any, numbers: bytearray) -> Any:
    """An object of JSON: the fields of a dataclass, or an array."""
    if raw.keys() != {ARRAY}:
        return raw
    kind, shape, order, begin = raw[ARRAY]
    count = math.prod(shape)
    if np.dtype(kind).hasobject or count < 0 or begin < 0:
        raise ValueError("an array is nowhere")
    return np.frombuffer(numbers, kind, count, begin).reshape(shape, order=order).copy(order)


# The forward runs of a data set under way, in their order. Between them nothing is random and nothing is read: an
# interrupted estimate that begins again asks for the same ones, and comes to the same bits.

LARGEST = 2**27  # bytes of a journal; what follows is run again


@dataclass(frozen=True)
class KnownRuns:
    """``forecasts``, and digests of the arrays (``keys``) that they were made of."""

    keys: tuple[str, ...] = ()
    forecasts: tuple[Forecast, ...] = ()


class Journal(Executor):
    """An ``executor`` of forward runs that are not made where they are known from ``before``. ``keeper`` writes them to
    a file, where its folder is seen. In a thread that is to stop the next one raises :class:`HaltedError`.
    """

    def __init__(self, executor: Executor, before: KnownRuns = KnownRuns(), keeper: Keeper | None = None):
        self.executor, self.workers, self.reads = executor, executor.workers, executor.reads
        self.keys, self.forecasts, self.at = list(before.keys), list(before.forecasts), 0
        self.room = LARGEST - sum(run.nbytes for run in before.forecasts)
        self.keeper = keeper

    def untold(self, progress: Progress | None) -> Progress | None:
        """What hears of what follows from the last run that is known on: the rest was told before the interruption."""
        return progress and (lambda name, record: progress(name, record) if self.at >= len(self.keys) else None)

    def once(self, run: Callable[..., Any], *asked: Array) -> Any:
        require_going_on()
        at, key = self.at, digest(b"".join(part.tobytes() for part in asked))
        self.at += 1
        if at < len(self.keys) and self.keys[at] == key:
            return self.forecasts[at]
        del self.keys[at:], self.forecasts[at:]
        forecast = run(*asked)
        if self.keeper and self.keeper.path.parent.is_dir() and at == len(self.keys) and self.room > 0:
            self.keys.append(key)
            self.forecasts.append(forecast)
            self.room -= forecast.nbytes
            self.keeper.keep(lambda: KnownRuns(tuple(self.keys), tuple(self.forecasts)))
        return forecast

    def map(self, *arguments: Any, **named: Any) -> Any:
        return self.executor.map(*arguments, **named)

    def trajectories(self, *arguments: Any) -> Any:
        return self.executor.trajectories(*arguments)

    def close(self) -> None:
        """The executor is closed by who made it."""
