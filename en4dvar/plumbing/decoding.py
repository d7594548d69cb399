"""Files of anybody that a library decodes: in a child process, within limits of processor time and memory.

A workbook of 300 kB may become 13 GB, a movie may send its library in circles or crash it. What decodes them runs in a
child, which is kept for the next file, and is ended where it takes more than it may. The limits count what the child
does, not how long it waits, so that a busy machine or a slow disk refuses nothing. Where the system knows no such
limits (Windows), only a crash stays in the child.

HDF5 files must be all there. A variable of netCDF may be kept in any file of the machine (external storage, virtual
data sets), and a group may be one of another file: whoever reads and hands on such a file hands on what it names. The
netCDF library neither tells nor refuses, so the links and data sets are looked through first, by h5py.
"""

import atexit
import os
import pickle
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from pkgutil import resolve_name
from typing import IO, Any, TypeVar, cast

from en4dvar.plumbing.children import Child, limit_memory, limit_time, status_named
from en4dvar.plumbing.errors import DataError, En4dvarError, retold
from en4dvar.plumbing.files import here, in_bytes, open_plain, read_plain

T = TypeVar("T")
Decoder = Callable[..., Iterator[Any]]
DOUBT = "it is damaged, or not what it says it is"
LONGEST_TEXT = 256_000_000  # bytes of a text
_VALUE, _END, _FAULT = range(3)
_idle: "list[_Child]" = []
_changing = threading.Lock()


@dataclass(frozen=True)
class Allowed:
    """What a decoder may take: ``seconds`` of processor time for each value that it gives, ``memory`` in bytes beyond
    what the child has at its start, files of at most ``size`` bytes.
    """

    seconds: int = 20
    memory: int = 2_000_000_000
    size: int = 2_000_000_000


class DecodeError(Exception):
    """What a library said that could not decode a file; the caller knows where it stood."""


def require_plain(path: Path, size: int) -> None:
    """Raises :class:`DataError` where a file is none that can be read to its end: a pipe, a device, too large."""
    with retold(OSError, DataError, f"{path}: "), open_plain(path) as file:
        length = os.fstat(file.fileno()).st_size
    if length > size:
        raise DataError(f"{path}: {in_bytes(length)}; at most {in_bytes(size)} are read")


def decoded(decoder: Decoder, path: Path, *arguments: Any, allowed: Allowed = Allowed()) -> Iterator[Any]:
    """The values of ``decoder(path, *arguments)``, a function of a module that gives them one by one, in a child.

    Raises :class:`DataError`: the file is none, or takes more than it may, or ends the process that decodes it; and
    what the decoder raises as such. :class:`DecodeError`: anything else that it raises, in words.
    """
    require_plain(path, allowed.size)
    with _changing:
        child = _idle.pop() if _idle else None
    if child is None or child.process.poll() is not None:
        child = _Child()
    done = False
    with child:
        try:
            request = f"{decoder.__module__}:{decoder.__qualname__}", (path, *arguments), allowed, here()
            with suppress(OSError):  # it is gone: told when its answer is read
                _write(cast(IO[bytes], child.process.stdin), request)
            while True:
                kind, value = child.receive(path, allowed)
                if kind == _VALUE:
                    yield value
                    continue
                done = True
                if kind == _FAULT:
                    raise value
                return
        finally:
            child.kept = done


def decoded_whole(
    decoder: Callable[..., Iterator[T]], path: Path, *arguments: Any, allowed: Allowed = Allowed(), kind: str = "a file"
) -> T:
    """The only value of a decoder. Raises :class:`DataError`, also for what its library says of a file of the kind."""
    value: T
    with retold(DecodeError, DataError, f"{path}: cannot be read as {kind}: "):
        (value,) = decoded(decoder, path, *arguments, allowed=allowed)
    return value


class _Child(Child):
    """A process that decodes one file after the other; on leaving it is ended unless it is to be ``kept``."""

    def __init__(self) -> None:
        words = [sys.executable, "-c", f"import sys; sys.path[:] = {sys.path!r}; from {__name__} import serve; serve()"]
        super().__init__(words, output=subprocess.PIPE, input=subprocess.PIPE)
        self.kept = False

    def __exit__(self, *exception: object) -> None:
        if not self.kept:
            super().__exit__(*exception)
            for pipe in (self.process.stdin, self.process.stdout):
                if pipe is not None:
                    with suppress(OSError):
                        pipe.close()
            return
        self.forget()
        self.kept = False
        with _changing:
            _idle.append(self)

    def receive(self, path: Path, allowed: Allowed) -> Any:
        """The next message. Raises :class:`DataError` where the child is gone."""
        assert self.process.stdout is not None
        try:
            return pickle.load(self.process.stdout)
        except (EOFError, OSError, pickle.UnpicklingError):  # the latter where it ended within an answer
            status = self.wait(None)
        if hasattr(signal, "SIGXCPU") and status == -signal.SIGXCPU:
            words = f"takes more than {allowed.seconds} s of processor time to be read"
        else:
            words = f"ends the process that reads it ({status_named(status)})"
        raise DataError(f"{path}: {words}; {DOUBT}")


@atexit.register
def _end_idle() -> None:
    while _idle:
        with _idle.pop():
            pass


def _write(pipe: IO[bytes], message: Any) -> None:
    pipe.write(pickle.dumps(message, protocol=5))  # all of it or, where it cannot be pickled, nothing
    pipe.flush()


def serve() -> None:
    """What the child does: one request after the other, until there is nobody to ask."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    requests, answers = sys.stdin.buffer, os.fdopen(os.dup(1), "wb")
    nowhere = os.open(os.devnull, os.O_RDWR)
    os.dup2(nowhere, 1)  # what a library prints is no answer
    with suppress(EOFError, OSError, pickle.UnpicklingError):
        while True:
            name, arguments, allowed, folder = pickle.load(requests)
            with suppress(OSError):  # names of files mean what they mean there
                os.chdir(folder)
            _write(answers, _served(name, arguments, allowed, answers))


def _served(name: str, arguments: tuple[Any, ...], allowed: Allowed, answers: IO[bytes]) -> tuple[int, Any]:
    """Give the values of a decoder; the last message of them."""
    try:
        decoder = resolve_name(name)
        limit_memory(allowed.memory)
        limit_time(allowed.seconds)
        for value in decoder(*arguments):
            _write(answers, (_VALUE, value))
            limit_time(allowed.seconds)
    except MemoryError:
        words = f"takes more than {in_bytes(allowed.memory)} of memory to be read"
        return _FAULT, DataError(f"{arguments[0]}: {words}; {DOUBT}")
    except En4dvarError as error:
        return _FAULT, DataError(str(error))
    except Exception as error:
        return _FAULT, DecodeError(" ".join(str(error).split())[:300] or type(error).__name__)
    return _END, None


def matches(path: Path, pattern: str) -> Iterator[list[str]]:
    """What a regular expression with one group finds in a file; a decoder. Raises :class:`DataError` as
    :func:`text_of`.
    """
    yield re.findall(pattern, text_of(path), re.MULTILINE)


def text_of(path: Path) -> str:
    """What a program has written, without a mark of byte order, its lines ended by ``\\n``; bytes that are no UTF-8
    are replaced.

    Raises :class:`DataError` where it cannot be read, or is longer than :data:`LONGEST_TEXT`.
    """
    with retold(OSError, DataError, f"no output file {path}: "):
        return read_plain(path, LONGEST_TEXT).decode("utf-8-sig", errors="replace").replace("\r\n", "\n")


MOST_OBJECTS = 100_000
DEEPEST = 30


class ForeignDataError(ValueError):
    """Something of the file lies in another one."""


def require_whole(path: Path) -> None:
    """Raises :class:`ForeignDataError` where something of an HDF5 file lies in another one; files that are none pass.
    Raises :class:`OSError`, :class:`RuntimeError` where it is damaged.
    """
    import h5py
    from h5py import h5d, h5g, h5l, h5o

    if not h5py.is_hdf5(path):
        return
    objects = 0
    with h5py.File(path, "r") as file, retold((KeyError, TypeError), RuntimeError):
        groups = [(file["/"].id, "", 0)]
        while groups:
            group, above, depth = groups.pop()
            objects += len(group)
            if objects > MOST_OBJECTS or depth > DEEPEST:
                raise ForeignDataError(f"more than {MOST_OBJECTS} objects, or groups {DEEPEST} deep")
            for name in group:
                path_inside, link = f"{above}/{name.decode('utf-8', 'replace')}", group.links.get_info(name).type
                if link == h5l.TYPE_SOFT:
                    continue  # to another name of this file, which is looked at where it stands
                if link != h5l.TYPE_HARD:
                    raise ForeignDataError(f"{path_inside} is a link into another file, which is not opened")
                held = h5o.open(group, name)
                if isinstance(held, h5g.GroupID):
                    groups.append((held, path_inside, depth + 1))
                elif isinstance(held, h5d.DatasetID):
                    how = held.get_create_plist()
                    own = how.get_layout() in (h5d.COMPACT, h5d.CONTIGUOUS, h5d.CHUNKED)
                    if not own or how.get_external_count():
                        raise ForeignDataError(f"the numbers of {path_inside} are in another file, which is not opened")
