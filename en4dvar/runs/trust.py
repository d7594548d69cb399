"""Whose code a result file may run: of this project and of installed packages; for other code the user is asked."""

from __future__ import annotations

import json
import sysconfig
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from importlib.metadata import distributions
from pathlib import Path
from urllib.parse import urlsplit

from en4dvar.user_code import RefusedError, permission

Ask = Callable[[str], bool]  # question → whether the user says yes


@contextmanager
def of_strangers(source: Path, ask: Ask | None, trust: bool) -> Iterator[None]:
    """Within, code that the result files of ``source`` name is loaded where the user may be supposed to know it.

    That is code below the working directory and in installed packages. Anything else, any command, and whatever is
    named by a relative path (a run records absolute ones), is loaded with ``trust`` or where ``ask`` says yes.

    Raises :class:`RefusedError` inside.
    """
    answers: dict[str, bool] = {}

    def require(what: str, file: Path | None, anything: bool) -> None:
        if file is None or trust or (_known(file) and not anything):
            return
        where = (source.absolute() / file.expanduser()).resolve()
        told = f"{source}: its {what} is code outside of this project, {where}"
        if anything:
            told = f"{source}: its {what} runs a program, {where}"
        if told not in answers:
            answers[told] = ask is not None and ask(f"{told}; run it?")
        if not answers[told]:
            raise RefusedError(f"{told}; read it, then give --trust to run it")

    with permission(require):
        yield


def _known(file: Path) -> bool:
    """Whether a file or package is of this project, or installed."""
    if not file.is_absolute():
        return False
    where = file.resolve()
    return where.is_relative_to(Path.cwd()) or any(where.is_relative_to(folder) for folder in _installed())


@cache
def _installed() -> tuple[Path, ...]:
    """Folders of the standard library, of installed packages and of those that are installed to be edited."""
    from urllib.request import url2pathname  # with it come HTTP, TLS and mail

    folders = {Path(sysconfig.get_path(name)) for name in ("stdlib", "platstdlib", "purelib", "platlib")}
    for found in distributions():
        folders.add(Path(str(found.locate_file(""))))
        with suppress(TypeError, ValueError, AttributeError):
            origin = json.loads(found.read_text("direct_url.json") or "{}")
            if origin.get("dir_info", {}).get("editable"):
                folders.add(Path(url2pathname(urlsplit(origin["url"]).path)))
    return tuple(folder.resolve() for folder in folders)
