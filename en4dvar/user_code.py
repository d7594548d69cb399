"""Code of somebody else, a model or a law: when it may be loaded, and how it may end.

It may raise anything, ``SystemExit`` too (``sys.exit``): that is a failure of this code, never the end of the program.
Ctrl-C and the time limit of a batch are meant for the program. While such code is loaded, it keeps what it changes in
the process to itself: the working directory, warnings, numpy's errors, what Ctrl-C does.
"""

from __future__ import annotations

import os
import signal
import sysconfig
import threading
import traceback
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from en4dvar.errors import ConfigError, En4dvarError

Permission = Callable[[str, Path | None, bool], None]
_permission: ContextVar[Permission | None] = ContextVar("permission", default=None)
_in_worker = False
_NOT_THE_USERS = (str(Path(__file__).parent), sysconfig.get_path("stdlib"))


class EndedError(En4dvarError):
    """Code of a user wanted to end the program, or raised what is no :class:`Exception`."""


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
    if isinstance(error, Stop) or (isinstance(error, KeyboardInterrupt) and _heeds_ctrl_c()):
        raise error
    ended = EndedError(describe(error))
    ended.__cause__ = error
    return ended


def reason_of(error: BaseException) -> str:
    """:func:`describe` of :func:`own_fault`: the reason why a member is lost."""
    fault = own_fault(error)
    return str(fault) if isinstance(fault, EndedError) else describe(fault)


def in_worker() -> None:
    """This process works for another one: Ctrl-C is not meant for it."""
    global _in_worker
    _in_worker = True


def _heeds_ctrl_c() -> bool:
    return threading.current_thread() is threading.main_thread() and not _in_worker


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
            line = _line(error)
            plain = isinstance(error, ImportError | AttributeError) and not line  # nobody's code was reached
            raise ConfigError(f"{what}: {error if plain else reason_of(error)}{line}") from error


def _line(error: BaseException) -> str:
    """The last line of the user's that the error went through; "" where it reached none."""
    files = [(f.filename, f.lineno) for f in traceback.extract_tb(error.__traceback__)]
    own = [(name, line) for name, line in files if not name.startswith(("<", *_NOT_THE_USERS))]
    return f" ({own[-1][0]}:{own[-1][1]})" if own else ""


@contextmanager
def kept_apart() -> Iterator[None]:
    """What the process shares is afterwards as it was."""
    folder, filters = _folder(), warnings.filters[:]
    mine = threading.current_thread() is threading.main_thread()
    handlers: dict[int, Any] = {n: signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)} if mine else {}
    try:
        with np.errstate():
            yield
    finally:
        for added in [f for f in warnings.filters if f[0] == "error" and f not in filters]:
            warnings.filters.remove(added)  # type: ignore[attr-defined]  # others are those of libraries it imports
        if folder and _folder() != folder:
            with suppress(OSError):
                os.chdir(folder)
        for number, handler in handlers.items():
            if handler is not None and signal.getsignal(number) is not handler:
                signal.signal(number, handler)


def _folder() -> str:
    """The working directory, "" where it is gone."""
    try:
        return os.getcwd()
    except OSError:
        return ""


def file_of(module: str) -> Path | None:
    """The file or folder of the top-level package that ``module`` belongs to, without importing it; None: not found."""
    try:
        spec = find_spec(module.partition(".")[0])
    except (ImportError, ValueError):
        return None
    if spec is None:
        return None
    folders = list(spec.submodule_search_locations or ())
    return Path(folders[0]) if folders else Path(spec.origin) if spec.has_location and spec.origin else None


def require_permission(what: str, file: Path | None, anything: bool = False) -> None:
    """Called before code that a configuration names is loaded; ``file``: its path as it is named, None: not known.

    ``anything``: what it does depends on more than the file, as with an interpreter and its arguments.

    Raises :class:`RefusedError` within :func:`permission`, where that refuses.
    """
    if (ask := _permission.get()) is not None:
        ask(what, file, anything)


@contextmanager
def permission(ask: Permission) -> Iterator[None]:
    """Within, ``ask(what, file, anything)`` is called before code that a configuration names runs, and may raise."""
    before = _permission.set(ask)
    try:
        yield
    finally:
        _permission.reset(before)
