"""Kernels: functions that numba compiles once and keeps on disk, in the user's cache folder, by their sources.

Numba would keep a kernel beside its source file. In an installation that is ``site-packages``, where ``pip uninstall``
leaves what it did not write: the folders that remain are a namespace package, and hide the next installation. It stamps
a kernel with the file of its outermost function only; an edit (or an upgrade) of a module that it calls would leave
stale machine code in use. And of processes that need the same kernel at the same time (a campaign's workers, a batch of
jobs, 20 first starts) each would compile it.

``NUMBA_CACHE_DIR`` goes before the user's cache folder; where neither can be written (a HOME that is read-only, as on
many clusters), a folder of the user's own below the system's temporary one is used, and a note says so.
"""

import gc
import os
import stat
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any, TypeVar

import numba
from filelock import FileLock
from llvmlite.binding import get_host_cpu_features, get_host_cpu_name
from numba.core.caching import CompileResultCacheImpl, FunctionCache, IndexDataCacheFile, _CacheLocator
from numba.core.compiler_lock import global_compiler_lock
from numba.core.event import Listener, install_listener
from platformdirs import user_cache_path

from en4dvar.plumbing.errors import ConfigError, OutputError

CACHE = "NUMBA_CACHE_DIR"
PATIENCE = 120.0  # s that a process waits for another one's compilation, which may have been stopped


class SignatureFiles(IndexDataCacheFile):
    """A file of machine code for each signature and stamp, there before the index names it.

    numba numbers the files and writes the index first. Of processes that start at once, one could then load what
    another has compiled for another signature; and a kill in between would leave an index that is of the sources of
    today with machine code of those before.
    """

    def save(self, key: Any, data: Any) -> None:
        digest = sha256(repr((self._source_stamp, key)).encode()).hexdigest()[:16]
        name = f"{self._index_name.removesuffix('.nbi')}.{digest}.nbc"
        self._save_data(name, data)
        self._save_index({**self._load_index(), key: name})


@cache
def kernel_folder() -> Path:
    """The folder of compiled kernels of this version of numba and this processor; it exists and can be written. Raises
    :class:`OutputError`: compiled code can be kept nowhere.
    """
    asked = os.environ.get(CACHE)
    folder = (Path(asked) if asked else user_cache_path("en4dvar", appauthor=False)) / _target()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError:
        folder = _temporary_folder() / _target()
        folder.mkdir(exist_ok=True)
    return folder


def _target() -> str:
    """A name for what machine code depends on beside its source: numba's version, the processor and its features."""
    name = os.environ.get("NUMBA_CPU_NAME") or get_host_cpu_name()
    features = os.environ.get("NUMBA_CPU_FEATURES")
    digest = sha256((get_host_cpu_features().flatten() if features is None else features).encode()).hexdigest()[:8]
    return f"numba-{numba.__version__}-{name}-{digest}"


def _temporary_folder() -> Path:
    """A folder below the system's temporary one, for this process and those that it starts; a note says so."""
    try:
        folder = _own_folder(Path(tempfile.gettempdir()))
    except OSError as error:
        words = f"no folder can be written to keep compiled code in ({error.strerror}); set {CACHE} to one"
        raise OutputError(words) from None
    asked = os.environ.get(CACHE)
    os.environ[CACHE] = str(folder)
    numba.config.reload_config()
    place = f"{CACHE}={asked}" if asked else "the user's cache folder"
    print(
        f"note: {place} cannot be written; compiled code is kept in {folder}, and compiled again where that is gone"
        f" (set {CACHE} to a folder that stays)",
        file=sys.stderr,
    )
    return folder


def _own_folder(temporary: Path) -> Path:
    """A folder that nobody else can write: numba runs what it finds there. It has the same name for every process of
    the user; where somebody else holds that name, a new one is made.
    """
    user = os.getuid() if hasattr(os, "getuid") else None
    folder = temporary / f"en4dvar-numba-{'user' if user is None else user}"
    with suppress(FileExistsError):
        folder.mkdir(mode=0o700)
    status = folder.lstat()
    foreign = user is not None and (status.st_uid != user or status.st_mode & (stat.S_IWGRP | stat.S_IWOTH))
    if foreign or not stat.S_ISDIR(status.st_mode) or not os.access(folder, os.W_OK):
        return Path(tempfile.mkdtemp(prefix="en4dvar-numba-", dir=temporary))
    return folder


class _Locator(_CacheLocator):
    """Where one kernel is kept: a folder for each folder of sources."""

    def __init__(self, function: Any, file: str):
        self._py_file, self._lineno = file, function.__code__.co_firstlineno

    @classmethod
    def from_function(cls, py_func: Any, py_file: str) -> "_Locator":
        return cls(py_func, py_file)

    def get_cache_path(self) -> str:
        return str(kernel_folder() / self.get_suitable_cache_subpath(self._py_file))

    def get_source_stamp(self) -> str:
        return sha256(Path(self._py_file).read_bytes()).hexdigest()

    def get_disambiguator(self) -> str:
        return str(self._lineno)


class _Kernels(CompileResultCacheImpl):
    _locator_classes: list[type[object]] = [_Locator]  # noqa: RUF012


class KernelCache(FunctionCache):
    """The machine code of one kernel, by signature and processor, until its source changes."""

    _impl_class = _Kernels

    def __init__(self, function: Any):
        FunctionCache.__init__(self, function)
        self.stamp(self._impl.locator.get_source_stamp())

    def stamp(self, stamp: str) -> None:
        """Use what was kept under this stamp only."""
        self._cache_file = SignatureFiles(self.cache_path, self._impl.filename_base, stamp)


def _digest(folder: Path, *more: Path) -> str:
    content = b"".join(path.read_bytes() for path in (*sorted(folder.glob("*.py")), *more))
    return sha256(content).hexdigest()


def stamp_with_sources(dispatcher: Any, folder: Path, *more: Path) -> None:
    """Replace the cache stamp of ``dispatcher``, a kernel, by the content of all modules in ``folder`` and ``more``."""
    dispatcher._cache.stamp(_digest(folder, *more))


def keep(dispatcher: Any) -> None:
    """Keep the machine code of ``dispatcher`` (made by ``numba.njit``) on disk for later processes.

    Of processes that need it for the same arguments, one compiles, and the others load what it kept.

    Raises :class:`OutputError`: compiled code can be kept nowhere.
    """
    dispatcher._cache = KernelCache(dispatcher.py_func)
    compile_: Callable[[Any], Any] = dispatcher.compile

    def alone(signature: Any) -> Any:
        cache = dispatcher._cache
        digest = sha256(repr(signature).encode()).hexdigest()[:16]
        # numba's lock first, as where one kernel is compiled within another: threads never wait for each other's file
        lock = Path(cache.cache_path) / f"{cache._impl.filename_base}.{digest}.lock"
        with global_compiler_lock, _held(lock), ExitStack() as stack:
            if gc.isenabled():  # to look for cycles among the compiler's million objects takes a tenth of its time
                gc.disable()
                stack.callback(gc.enable)
            return compile_(signature)

    dispatcher.compile = alone


@contextmanager
def _held(path: Path) -> Iterator[None]:
    """Within, no other process is; where files cannot be locked, or after :data:`PATIENCE`, another one may be."""
    with ExitStack() as stack:
        with suppress(OSError):
            path.parent.mkdir(parents=True, exist_ok=True)
            stack.enter_context(FileLock(path, timeout=PATIENCE, mode=0o600))
        yield


F = TypeVar("F", bound=Callable[..., Any])
_NO_ENTRY: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
KERNELS: list[Any] = []
"""Every kernel that has been declared so far in this process."""


def _kernels(**options: Any) -> Callable[[F], F]:
    """Functions compiled by numba with these options, kept on disk, without the interpreter's lock. Raises
    :class:`OutputError`: nowhere can compiled code be kept.
    """

    def compiled(function: F) -> F:
        if getattr(numba.config, "DISABLE_JIT", 0):
            raise ConfigError("NUMBA_DISABLE_JIT is set, but the solver's kernels run compiled alone; unset it")
        made: F = numba.njit(nogil=True, **options)(function)
        keep(made)
        KERNELS.append(made)
        return made

    return compiled


kernel = _kernels()
kernel_without_allocation = _kernels(_nrt=False)
"""A :func:`kernel` that makes no arrays: no references to them need be counted."""
kernel_called_by_address = _kernels(_nrt=False, error_model="numpy", **_NO_ENTRY)
"""The same that only other kernels call, with the numbers that IEEE 754 gives a division by zero."""
called: Callable[[F], F] = numba.njit(**_NO_ENTRY)
"""Compiled into the kernels that call it, not to be called from Python: entries for that take time to compile."""
inlined: Callable[[F], F] = numba.njit(forceinline=True, **_NO_ENTRY)
"""The same, without a call."""


def compilations() -> int:
    """How often a kernel was compiled in this process, because nothing kept on disk served its arguments."""
    return sum(sum(kernel.stats.cache_misses.values()) for kernel in KERNELS)


@contextmanager
def watch_compilation(tell: Callable[[], None]) -> Iterator[None]:
    """Within, ``tell`` is called when this process begins to compile what is not kept on disk."""
    with install_listener("numba:compile", _Watcher(tell)):
        yield


class _Watcher(Listener):
    def __init__(self, tell: Callable[[], None]):
        self._tell = tell

    def on_start(self, event: Any) -> None:
        self._tell()

    def on_end(self, event: Any) -> None:
        """What comes next is told by who does it."""
