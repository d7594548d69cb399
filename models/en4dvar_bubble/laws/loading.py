"""Finding a law: built in, an entry point, a class of an installed package, or a class in a file of the user's own."""

from __future__ import annotations

import hashlib
import sys
import traceback
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import entry_points
from pathlib import Path
from types import ModuleType
from typing import Any

from en4dvar.errors import ConfigError
from en4dvar.hints import no_such_file, suggest
from en4dvar.user_code import file_of, kept_apart, loading, reason_of, require_permission
from en4dvar_bubble.laws.base import FILE_MODULE, REGISTRY, ConstitutiveLaw
from en4dvar_bubble.laws.validity import check_law

GROUP = "en4dvar_bubble.laws"


@dataclass(frozen=True)
class FileReference:
    """Where a law was loaded from: absolute path, class name and hash of the source."""

    path: str
    name: str
    digest: str

    def __call__(self) -> ConstitutiveLaw:
        """The unpickled law, loaded again. Raises :class:`ConfigError` if the file is no longer the same."""
        path = Path(self.path)
        if path.is_file() and _digest(path, path.read_bytes()) != self.digest:
            raise ConfigError(f"{path}: the file has changed since the law {self.name} was loaded from it")
        law: ConstitutiveLaw = _from_file(path, self.name)()
        return law


def get_law(name: str, base: Path | None = None) -> ConstitutiveLaw:
    """The law called ``name``.

    A built-in name; the name of an entry point of group ``en4dvar_bubble.laws``; ``package.module:Class``; or
    ``file.py:Class`` with the path relative to ``base`` (default: the working directory).

    Raises :class:`ConfigError`: no such law, file or class (with a suggestion), the file cannot be executed, the class
    is not a usable law.
    """
    if name in REGISTRY:
        return REGISTRY[name]()
    where, colon, attribute = name.rpartition(":")
    if colon and (where.endswith(".py") or "/" in where or "\\" in where):
        path = ((base or Path.cwd()) / Path(where).expanduser()).resolve()
        require_permission(f"law {name!r}", Path(where))
        found = _from_file(path, attribute)
    elif colon:
        require_permission(f"law {name!r}", file_of(where))
        found = _from_module(where, attribute)
    else:
        found = _from_entry_point(name)
    return check_law(found, name)


def qualified(name: str, base: Path | None = None) -> str:
    """``name`` with the path of a ``file.py:Class`` made absolute, so that it means the same from any folder."""
    reference = type(get_law(name, base)).reference
    return f"{reference.path}:{reference.name}" if reference else name


def available() -> dict[str, type[ConstitutiveLaw] | ConfigError]:
    """Every registered law by name, built in or by entry point; an entry point that fails, as its error."""
    laws: dict[str, type[ConstitutiveLaw] | ConfigError] = {}
    for entry in entry_points(group=GROUP):
        try:
            laws[entry.name] = type(get_law(entry.name))
        except ConfigError as error:
            laws[entry.name] = error
    return dict(sorted((laws | REGISTRY).items()))


def _from_file(path: Path, attribute: str) -> Any:
    if not path.is_file():
        raise ConfigError(no_such_file(path))
    source = path.read_bytes()
    digest = _digest(path, source)
    key = f"{FILE_MODULE}{digest[:20]}"
    if key not in sys.modules:
        module = ModuleType(key)
        module.__file__ = str(path)
        sys.modules[key] = module
        try:
            with kept_apart():
                exec(compile(source, str(path), "exec"), module.__dict__)
        except BaseException as error:
            del sys.modules[key]
            raise ConfigError(f"{_line(error, path)}: {reason_of(error)}") from error
    found = _attribute(sys.modules[key], attribute, str(path))
    if isinstance(found, type) and issubclass(found, ConstitutiveLaw) and found.__module__ == key:
        found.reference = FileReference(str(path), attribute, digest)
    return found


def _from_module(where: str, attribute: str) -> Any:
    with loading(f"law '{where}:{attribute}' cannot be imported"):
        return _attribute(import_module(where), attribute, where)


def _from_entry_point(name: str) -> Any:
    registered = {entry.name: entry for entry in entry_points(group=GROUP)}
    if name not in registered:
        known = sorted({*REGISTRY, *registered})
        own = "; a class of your own is my_law.py:ClassName" if name.endswith(".py") else ""
        raise ConfigError(f"unknown law {name!r}{own or suggest(name, known)}")
    with loading(f"law {name!r}: entry point {registered[name].value!r} cannot be loaded"):
        return registered[name].load()


def _attribute(module: ModuleType, name: str, where: str) -> Any:
    if not hasattr(module, name):
        classes = [n for n, v in vars(module).items() if isinstance(v, type) and v.__module__ == module.__name__]
        raise ConfigError(f"{where}: no class {name!r}{suggest(name, classes)}")
    return getattr(module, name)


def _digest(path: Path, source: bytes) -> str:
    return hashlib.sha256(str(path).encode() + b"\0" + source).hexdigest()


def _line(error: BaseException, path: Path) -> str:
    """``file:line`` of the error in the user's file."""
    if isinstance(error, SyntaxError) and error.filename == str(path):
        return f"{path}:{error.lineno}"
    lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == str(path)]
    return f"{path}:{lines[-1]}" if lines else str(path)
