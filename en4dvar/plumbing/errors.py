"""Errors a user can cause, each with the exit code of the command line."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from en4dvar.plumbing.hints import beside


class En4dvarError(Exception):
    """Base class: the message alone tells where and what to do; the CLI prints it without a traceback."""

    exit_code = 1


@dataclass(frozen=True)
class Fault:
    """One fault in a configuration: ``file:line:col: path: message``."""

    message: str
    path: str = ""
    file: str = ""
    line: int = 0
    column: int = 0

    def __str__(self) -> str:
        where = ":".join(str(part) for part in (self.file, self.line, self.column) if part)
        path = "" if where.startswith("--") and where.partition(" ")[2] in ("", self.path) else self.path
        return ": ".join(part for part in (where, path, self.message) if part)


class ConfigError(En4dvarError):
    """The configuration cannot be used; carries every problem found, not only the first.

    ``path``: the key of a single problem, which is told by its message.
    """

    exit_code = 2

    def __init__(self, problems: Sequence[Fault] | str, path: str = ""):
        self.problems = (Fault(problems, path),) if isinstance(problems, str) else tuple(problems)
        super().__init__("\n".join(str(p) for p in self.problems))


class DataError(En4dvarError):
    """A data file cannot be used; ``series`` is the name of the one it holds, where the data are several."""

    exit_code = 2

    def __init__(self, message: str, series: str = ""):
        self.series = series
        super().__init__(message)


class OutputError(En4dvarError):
    """The run directory cannot be used."""

    exit_code = 2


class TooFewMembersError(En4dvarError):
    """Too few members survived a forecast for the ensemble statistics to mean anything."""

    exit_code = 3


@contextmanager
def retold(
    caught: type[Exception] | tuple[type[Exception], ...], kind: type[Exception], words: str = "", *more: str
) -> Iterator[None]:
    """Raise what is ``caught`` in the block as ``kind(words + message, *more)``, of system errors the reason alone, and
    of a file to be read that is not there what lies beside it."""
    try:
        yield
    except caught as error:
        reason = getattr(error, "strerror", None) or error
        if isinstance(error, FileNotFoundError) and error.filename and not issubclass(kind, OutputError):
            reason = beside(Path(error.filename))
        raise kind(f"{words}{reason}", *more) from None
