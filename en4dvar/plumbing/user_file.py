"""Classes in a file of the user's own, ``file.py:Class``, without installing it and without touching ``sys.path``.

The file becomes a module below this one, named after its path and its content. So whatever is defined there is pickled
by name and imported again in any other process that sees the file, as long as it is the same.
"""

import hashlib
import os
import sys
import traceback
from importlib import import_module
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from types import ModuleType
from typing import Any, cast

from en4dvar.plumbing.errors import ConfigError, retold
from en4dvar.plumbing.files import expanded, read_plain
from en4dvar.plumbing.hints import suggest
from en4dvar.plumbing.user_code import Code, kept_apart, reason_of, require_permission

__path__: list[str] = []  # modules can be imported from below this one
_PREFIX = f"{__name__}."
LONGEST = 10_000_000  # bytes of a file of code
_permitted: dict[tuple[Path, str], bytes] = {}  # file and digest → its source, once it may run


def is_file_reference(name: str) -> bool:
    """True if ``name`` is ``file.py:Class`` rather than ``package:Class``, ``tcp://host:8786`` or a single word."""
    where, colon, attribute = name.rpartition(":")
    in_folder = attribute.isidentifier() and ("/" in where or "\\" in where)
    return bool(colon) and (where.endswith(".py") or in_folder)


def is_from_file(kind: type) -> bool:
    """True if a class was loaded by :func:`load`."""
    return kind.__module__.startswith(_PREFIX)


def absolute(name: str, base: Path | None = None) -> str:
    """A reference that means the same from any folder; ``base``: where a relative one starts, else where we are."""
    where, _, attribute = name.rpartition(":")
    return f"{os.path.realpath((base or Path.cwd()) / expanded(where))}:{attribute}"


def load(name: str, what: str) -> Any:
    """What an :func:`absolute` reference names; ``what`` it is, for the user who is asked.

    The file is opened once: what is asked about is what runs.

    Raises :class:`ConfigError`: no such file, it cannot be executed (with the line), or it holds no such class.
    :class:`RefusedError`: it may not be loaded, see :func:`~en4dvar.plumbing.user_code.require_permission`.
    """
    where, _, attribute = name.rpartition(":")
    path = Path(os.path.realpath(where))
    source = _source(path)
    digest = hashlib.sha256(source).hexdigest()
    require_permission(Code(what, (path,), digest=digest))
    _permitted[path, digest] = source
    try:
        with kept_apart():
            module = import_module(f"{_PREFIX}{str(path).encode('utf-8', 'surrogateescape').hex()}_{digest}")
    except BaseException as error:
        raise ConfigError(f"{_line(error, path)}: {reason_of(error)}") from error
    finally:
        _permitted.pop((path, digest), None)
    return class_of(module, attribute, where)


def class_of(module: ModuleType, attribute: str, where: str) -> Any:
    """``attribute`` of a module. Raises :class:`ConfigError`: none there, told with ``where`` and what is like it."""
    if not hasattr(module, attribute):
        classes = [n for n, v in vars(module).items() if isinstance(v, type) and v.__module__ == module.__name__]
        raise ConfigError(f"{where}: no class {attribute!r}{suggest(attribute, classes)}")
    return getattr(module, attribute)


class _Files(MetaPathFinder, Loader):
    """Finds modules by the names that :func:`load` gives them, and executes what is permitted."""

    def find_spec(self, fullname: str, path: object = None, target: object = None) -> ModuleSpec | None:
        if not fullname.startswith(_PREFIX):
            return None
        where, _, digest = fullname.removeprefix(_PREFIX).partition("_")
        file = bytes.fromhex(where).decode("utf-8", "surrogateescape")
        return ModuleSpec(fullname, self, origin=file, loader_state=digest)

    def exec_module(self, module: ModuleType) -> None:
        spec = cast(ModuleSpec, module.__spec__)
        file, digest = Path(spec.origin or ""), spec.loader_state
        source = _permitted.pop((file, digest), None)
        if source is None:  # imported by its name: by a worker, or by a file that names this module
            source = _source(file)
            if hashlib.sha256(source).hexdigest() != digest:
                raise ConfigError(f"{file}: the file has changed since it was loaded")
            require_permission(Code(f"file {file.name!r}", (file,), digest=digest))
        module.__file__ = str(file)
        exec(compile(source, str(file), "exec"), module.__dict__)


def _source(path: Path) -> bytes:
    with retold((OSError, ValueError), ConfigError, f"{path}: "):
        return read_plain(path, LONGEST)


def _line(error: BaseException, path: Path) -> str:
    """``file:line`` of the error in the user's file."""
    if isinstance(error, SyntaxError) and error.filename == str(path):
        return f"{path}:{error.lineno}"
    lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == str(path)]
    return f"{path}:{lines[-1]}" if lines else str(path)


sys.meta_path.insert(sys.meta_path.index(PathFinder) if PathFinder in sys.meta_path else 0, _Files())
