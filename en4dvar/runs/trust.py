"""Whose code a result file may run: what is installed, and what a configuration of the user's own has named.

A result file is never the user's own, wherever it lies and wherever its code lies: both come in one archive. So a path
is known only if this user has run or checked a configuration that names it, with the content that it has now
(:class:`~en4dvar.plumbing.user_code.Code`).
"""

import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import cache
from importlib.metadata import distributions
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from en4dvar.config import AnyConfig, resolve_any
from en4dvar.config.load import recorded
from en4dvar.plumbing.errors import OutputError
from en4dvar.plumbing.user_code import Code, RefusedError, is_installed, permission

Ask = Callable[[str], bool]  # question → whether the user says yes


@contextmanager
def of_strangers(source: Path, ask: Ask | None, trust: bool) -> Iterator[None]:
    """Within, code that the result files of ``source`` name is loaded where the user is known to know it.

    That is code of installed packages, and code that a configuration of the user's has named before. Anything else,
    and any command, is loaded with ``trust`` or where ``ask`` says yes.

    Raises :class:`RefusedError` inside.
    """
    answers: dict[str, bool] = {}

    def require(code: Code) -> None:
        if trust or not code.places or _is_known(code):
            return
        where = ", ".join(map(str, code.places))
        does = "is code that no configuration of yours has named as it is now" if code.digest else "runs a program"
        told = f"{source}: its {code.what} {does}, {where}"
        if told not in answers:
            answers[told] = ask is not None and ask(f"{told}; run it?")
        if not answers[told]:
            raise RefusedError(f"{told}; read it, then give --trust to run it")

    with permission(require):
        yield


def recorded_config(run_dir: Path, attributes: Mapping[Any, Any], trust: bool, ask: Ask | None) -> AnyConfig:
    """The configuration that a result of a run records. Raises :class:`ConfigError`, :class:`RefusedError`.
    :class:`OutputError`: a program has written the result, and nothing is recorded.
    """
    if not {"configuration_resolved", "identity"} <= attributes.keys():
        raise OutputError(f"{run_dir}: its results do not record a configuration; they were written by a program")
    document = recorded(str(attributes["configuration_resolved"]), f"{run_dir}: configuration_resolved")
    with of_strangers(run_dir, ask, trust):
        return resolve_any(document, run_dir.absolute())


def _is_known(code: Code) -> bool:
    """Whether code is installed, or was named by a configuration of the user's."""
    folders = _edited().get(code.package, ())
    if code.package and all(is_installed(at) or any(at.is_relative_to(to) for to in folders) for at in code.places):
        return True
    return code.was_named()


@cache
def _edited() -> dict[str, tuple[Path, ...]]:
    """Name of a package that is installed to be edited → the folders of the projects that hold it."""
    from urllib.request import url2pathname  # with it come HTTP, TLS and mail

    folders: dict[str, tuple[Path, ...]] = {}
    for package in distributions():
        with suppress(TypeError, ValueError, AttributeError):
            origin = json.loads(package.read_text("direct_url.json") or "{}")
            if origin.get("dir_info", {}).get("editable"):
                folder = Path(url2pathname(urlsplit(origin["url"]).path)).resolve()
                for name in (package.read_text("top_level.txt") or "").split():
                    folders[name] = (*folders.get(name, ()), folder)
    return folders
