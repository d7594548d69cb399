"""Code of somebody else, a model or a law: when it may be loaded, and how it may end.

It may raise anything, ``SystemExit`` too (``sys.exit``): that is a failure of this code, never the end of the program.
Ctrl-C and the time limit of a batch are meant for the program. While such code is loaded, it keeps what it changes in
the process to itself: the working directory, warnings, numpy's errors, what Ctrl-C does.
"""

import hashlib
import os
import re
import signal
import sysconfig
import threading
import traceback
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Any, cast

from en4dvar.plumbing.errors import ConfigError, En4dvarError
from en4dvar.plumbing.files import here, read_plain

Permission = Callable[["Code"], None]
_permission: ContextVar[Permission | None] = ContextVar("permission", default=None)
LONGEST = 100_000_000  # bytes of a file of code
MISTAKES = (AttributeError, ImportError, LookupError, NameError, TypeError)  # of the author, not of a state
_in_worker = False
_INSTALLED = {"site-packages", "dist-packages"}  # of this environment, of the user, of the Python below it
_NOT_THE_USERS = (str(Path(__file__).parents[1]), sysconfig.get_path("stdlib"))


class EndedError(En4dvarError):
    """Code of a user wanted to end the program, or raised what is no :class:`Exception`."""


class ReturnedError(En4dvarError):
    """Code of a user returned what cannot be used: which, what came, what is expected."""


class RefusedError(En4dvarError):
    """Code that may not be loaded; see :func:`permission`."""

    exit_code = 2


class Stop(BaseException):
    """Base of what stops code of a user from outside; nobody takes it for a fault of that code."""


def describe(error: BaseException) -> str:
    """An exception as the reason of a failure."""
    if isinstance(error, SystemExit):
        return f"SystemExit: sys.exit({'' if error.code is None else repr(error.code)})"
    return f"{type(error).__name__}: {error}" if str(error) or isinstance(error, Exception) else type(error).__name__


def own_fault(error: BaseException) -> Exception:
    """What code of a user raised, as an :class:`Exception`; raised as it is where it is meant for the program."""
    if isinstance(error, Exception):
        return error
    heeds_ctrl_c = threading.current_thread() is threading.main_thread() and not _in_worker
    if isinstance(error, Stop) or (isinstance(error, KeyboardInterrupt) and heeds_ctrl_c):
        raise error
    ended = EndedError(describe(error))
    ended.__cause__ = error
    return ended


def reason_of(error: BaseException) -> str:
    """:func:`describe` of :func:`own_fault`: the reason why a member is lost."""
    fault = own_fault(error)
    return str(fault) if isinstance(fault, EndedError | ReturnedError) else describe(fault)


def loss_of(error: BaseException) -> str:
    """:func:`reason_of`, and of a mistake in the code its line, without the folder: records of moved files agree."""
    where = line_of(error) if isinstance(error, MISTAKES) else ""
    return reason_of(error) + re.sub(r"\(.*[/\\]", "(", where)


def in_worker() -> None:
    """This process works for another one: Ctrl-C is not meant for it."""
    global _in_worker
    _in_worker = True


@contextmanager
def loading(what: str) -> Iterator[None]:
    """Within, code of a user is imported or built. Raises :class:`ConfigError`: it raised anything, told as ``what``.
    Errors of ours and :class:`ValueError`, which says what is wrong with a setting, go through.
    """
    with kept_apart():
        try:
            yield
        except (En4dvarError, ValueError):
            raise
        except BaseException as error:
            line = line_of(error)
            plain = isinstance(error, ImportError | AttributeError) and not line  # nobody's code was reached
            raise ConfigError(f"{what}: {error if plain else reason_of(error)}{line}") from error


def line_of(error: BaseException) -> str:
    """The last line of the user's that the error went through, if there is one outside of installed packages, or ""."""
    files = [(f.filename, f.lineno) for f in traceback.extract_tb(error.__traceback__)]
    own = [(name, line) for name, line in files if not name.startswith(("<", *_NOT_THE_USERS))]
    own = [(name, line) for name, line in own if not _INSTALLED & {*Path(name).parts}] or own
    return f" ({own[-1][0]}:{own[-1][1]})" if own else ""


@contextmanager
def kept_apart() -> Iterator[None]:
    """What the process shares is afterwards as it was."""
    folder, filters = here(), warnings.filters[:]
    mine = threading.current_thread() is threading.main_thread()
    handlers: dict[int, Any] = {n: signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)} if mine else {}
    try:
        import numpy as np  # here, for it is most of the time that a process which decodes takes to start

        with np.errstate():
            yield
    finally:
        for added in [f for f in warnings.filters if f[0] == "error" and f not in filters]:
            cast(list[Any], warnings.filters).remove(added)  # others are those of libraries it imports
        if folder and here() != folder:
            with suppress(OSError):
                os.chdir(folder)
        for number, handler in handlers.items():
            if handler is not None and signal.getsignal(number) is not handler:
                signal.signal(number, handler)


@dataclass(frozen=True)
class Code:
    """Code that is about to be loaded or run: ``what`` names it, ``places`` are where it lies, resolved.

    ``package``: the top-level name of what is imported by name; ``digest``: SHA-256 of the content, "" where what it
    does depends on more than that, as with a program and its arguments.
    """

    what: str
    places: tuple[Path, ...]
    package: str = ""
    digest: str = ""

    @property
    def mark(self) -> Path | None:
        """The file that stands for it once the user's own configuration has named it; None: nothing does."""
        from platformdirs import user_state_path

        folder = user_state_path("en4dvar", appauthor=False)
        if not self.digest or not folder.is_absolute():  # no home is known
            return None
        named = "\0".join([*map(str, self.places), self.digest])
        return folder / "own-code" / hashlib.sha256(named.encode("utf-8", "surrogateescape")).hexdigest()

    def was_named(self) -> bool:
        """Whether a configuration of this user has named it, with the content that it has now."""
        return self.mark is not None and self.mark.is_file()

    def remember(self) -> None:
        """From now on :meth:`was_named`, where that can be kept at all."""
        if self.mark is not None and not self.mark.exists():
            with suppress(OSError):
                self.mark.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
                self.mark.touch(mode=0o600)


def imported(what: str, module: str) -> ModuleType:
    """A module by its name, where that is permitted. Raises whatever its code raises, and :class:`RefusedError`."""
    require_permission(_code_of(what, module))
    return import_module(module)


def _code_of(what: str, module: str) -> Code:
    """The code that the import of ``module`` runs, found without importing it."""
    top = module.partition(".")[0]
    try:
        spec = find_spec(top)
    except (ImportError, ValueError):
        spec = None
    named = [] if spec is None else list(spec.submodule_search_locations or ()) or [spec.origin or ""]
    places = tuple(Path(place).resolve() for place in named if os.path.exists(place))
    if all(is_installed(place) for place in places):
        return Code(what, places, top)
    files = sorted(file for place in places for file in (place.rglob("*.py") if place.is_dir() else [place]))
    content = hashlib.sha256()
    for file in files:
        content.update(f"{file}\0".encode("utf-8", "surrogateescape"))
        with suppress(OSError):
            content.update(read_plain(file, LONGEST))
    return Code(what, places, top, content.hexdigest())


def is_installed(place: Path) -> bool:
    """Whether a resolved path lies where packages are installed."""
    return any(place.is_relative_to(Path(sysconfig.get_path(name)).resolve()) for name in ("purelib", "platlib"))


def require_permission(code: Code) -> None:
    """Called before code that a configuration names is loaded or run.

    The configuration is the user's own unless this is called within :func:`permission`; then it is a result file's.

    Raises :class:`RefusedError` within :func:`permission`, where that refuses.
    """
    if (ask := _permission.get()) is not None:
        ask(code)
    elif not _in_worker:
        code.remember()


@contextmanager
def permission(ask: Permission) -> Iterator[None]:
    """Within, ``ask(code)`` is called before code that a configuration names runs, and may raise."""
    before = _permission.set(ask)
    try:
        yield
    finally:
        _permission.reset(before)
