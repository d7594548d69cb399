"""Finding a law: built in, an entry point, a class of an installed package, or a class in a file of the user's own."""

from __future__ import annotations

from importlib import import_module
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

from en4dvar import user_file
from en4dvar.errors import ConfigError
from en4dvar.hints import suggest
from en4dvar.user_code import file_of, loading, require_permission
from en4dvar_bubble.laws.base import REGISTRY, ConstitutiveLaw
from en4dvar_bubble.laws.validity import check_law

GROUP = "en4dvar_bubble.laws"


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
    if user_file.is_file_reference(name):
        require_permission(f"law {name!r}", Path(where))
        found = user_file.load(user_file.absolute(name, base))
    elif colon:
        require_permission(f"law {name!r}", file_of(where))
        found = _from_module(where, attribute)
    else:
        found = _from_entry_point(name)
    return check_law(found, name)


def qualified(name: str, base: Path | None = None) -> str:
    """``name`` with the path of a ``file.py:Class`` made absolute, so that it means the same from any folder."""
    return user_file.absolute(name, base) if user_file.is_from_file(type(get_law(name, base))) else name


def available() -> dict[str, type[ConstitutiveLaw] | ConfigError]:
    """Every registered law by name, built in or by entry point; an entry point that fails, as its error."""
    laws: dict[str, type[ConstitutiveLaw] | ConfigError] = {}
    for entry in entry_points(group=GROUP):
        try:
            laws[entry.name] = type(get_law(entry.name))
        except ConfigError as error:
            laws[entry.name] = error
    return dict(sorted((laws | REGISTRY).items()))


def _from_module(where: str, attribute: str) -> Any:
    with loading(f"law '{where}:{attribute}' cannot be imported"):
        return user_file.class_of(import_module(where), attribute, where)


def _from_entry_point(name: str) -> Any:
    registered = {entry.name: entry for entry in entry_points(group=GROUP)}
    if name not in registered:
        known = {law: REGISTRY[law].title if law in REGISTRY else "" for law in sorted({*REGISTRY, *registered})}
        own = "; a class of your own is my_law.py:ClassName" if name.endswith(".py") else ""
        raise ConfigError(f"unknown law {name!r}{own or suggest(name, known)}")
    with loading(f"law {name!r}: entry point {registered[name].value!r} cannot be loaded"):
        return registered[name].load()
