"""A data file that is there, of a known format, and whatever goes wrong in reading it as one kind of error."""

import csv
import os
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from typing import get_args

from en4dvar.inputs.asked import SUFFIXES, Format, Layout
from en4dvar.plumbing.errors import DataError, retold
from en4dvar.plumbing.files import kind_of
from en4dvar.plumbing.hints import no_such_file

SHEETS = (".xls", ".xlsb", ".ods")


@contextmanager
def opened(path: Path, layout: Layout) -> Iterator[Format]:
    """The format of a file that is there. Raises :class:`DataError`, also where reading inside fails."""
    require_file(path)
    kind = format_of(path, layout)
    if kind is None:
        hint = (
            "save the sheet as CSV"
            if path.suffix.lower() in SHEETS
            else f"say what it is (data.format: {', '.join(get_args(Format))})"
        )
        raise DataError(f"{path}: the format cannot be told from the suffix {path.suffix!r}; {hint}")
    with readable(path):
        yield kind


def format_of(path: Path, layout: Layout) -> Format | None:
    """As it is said, else that of the suffix, where it is known."""
    return layout.format or SUFFIXES.get(path.suffix.lower())


def readable(path: Path) -> AbstractContextManager[None]:
    """Whatever goes wrong in the system or in the csv module as :class:`DataError`."""
    return retold((OSError, csv.Error), DataError, f"{path}: ")


def require_file(path: Path) -> None:
    """Raises :class:`DataError` where there is no plain file: nothing, a directory, a pipe, a device."""
    if not os.path.isfile(path):  # Path.is_file raises for a name that is too long, or in a closed folder
        with suppress(OSError):
            raise DataError(f"{path}: is {kind_of(os.stat(path).st_mode)}, not a file")
        raise DataError(no_such_file(path))
