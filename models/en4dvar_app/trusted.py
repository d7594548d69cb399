"""What a configuration of somebody else may not do from the page: run code, and read files outside of the folder."""

import glob
import os
from collections.abc import Iterator
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import Any

from en4dvar.plumbing.errors import ConfigError, En4dvarError, OutputError
from en4dvar.plumbing.files import PathError, expanded
from en4dvar.plumbing.user_code import RefusedError

MOST = 100_000  # files that a pattern names


def below(root: Path, name: str) -> Path:
    """The path of ``name`` in the folder ``root``, which is resolved. Raises OutputError: it leads out of the folder,
    through a link too, or a command would take it for an option.
    """
    try:
        path = (root / name).resolve()
        within = bool(name) and "\0" not in name and not Path(name).anchor and path.is_relative_to(root)
    except (OSError, ValueError):
        within = False
    if not within or name.startswith("-") or path == root:
        raise OutputError(f"{name!r} is not the name of a file in {root}; names that begin with '-' are refused too")
    return path


def require_harmless(root: Path, config: Path, trust: bool) -> None:
    """Refuse a configuration that names paths outside of ``root``, or code that the user does not know.

    Code is known as the command line knows it in the result files of others (:mod:`en4dvar.runs.trust`).

    Raises RefusedError, and :class:`OutputError` for a path. Other faults are left to the command, which says where
    they are.
    """
    from en4dvar.config import resolve_any
    from en4dvar.config.document import document_from
    from en4dvar.runs.trust import of_strangers

    if below(root, config.relative_to(root).as_posix()) != config:
        raise OutputError(f"{config}: is a link, which the page does not follow")
    try:
        document, base = document_from(config)
    except ConfigError:
        return
    for text in _strings(document.data):
        for path in _named(base, text):
            if not path.resolve().is_relative_to(root):
                raise OutputError(f"{config.name}: {text!r} leads to {path}, outside of the folder {root}")
    questions: list[str] = []

    def ask(question: str) -> bool:  # kept here, for what is refused may be told as a fault among others
        questions.append(question)
        return False

    with of_strangers(config, ask, trust), suppress(En4dvarError):
        resolve_any(document, base)
    if questions:
        why = questions[0].removesuffix("; run it?")
        raise RefusedError(f"{why}; read it, then start 'en4dvar app' with --trust, or run it by the command line")


def _strings(value: Any) -> Iterator[str]:
    if isinstance(value, dict):
        value = [*value, *value.values()]
    if isinstance(value, list):
        for part in value:
            yield from _strings(part)
    elif isinstance(value, str):
        yield value


def _named(base: Path, text: str) -> Iterator[Path]:
    """The paths that a text may stand for: a file, a folder and what is in it, or the files of a pattern."""
    try:
        path = base / expanded(text)
        yield path
        if glob.has_magic(text) and not os.path.lexists(path):
            first = next(i for i, part in enumerate(path.parts) if glob.has_magic(part))
            fixed = Path(*path.parts[:first])
            yield fixed / ".." if ".." in path.parts[first:] else fixed
            if fixed.resolve().is_relative_to(base.resolve()):
                yield from map(Path, islice(glob.iglob(str(path), recursive=True), MOST))
        elif path.is_dir():
            yield from islice(path.iterdir(), MOST)
    except (PathError, OSError, ValueError):
        return
