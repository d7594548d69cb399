"""What is asked of a data file: which columns in which units, how it is laid out, which of its parts.

And the file itself: that is there, of a known format, and whatever goes wrong in reading it as one kind of error.
"""

import csv
import os
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

from en4dvar.inputs.text_table import Decimal
from en4dvar.inputs.window import BY_NAME, Instant
from en4dvar.plumbing.errors import DataError, retold
from en4dvar.plumbing.files import kind_of
from en4dvar.plumbing.hints import no_such_file

Format = Literal["csv", "mat", "xlsx"]
Disorder = Literal["refuse", "sort"]
Repeated = Literal["refuse", "average"]
Outliers = Literal["keep", "leave out"]
_TEXT: Mapping[str, Format] = {".csv": "csv", ".txt": "csv", ".dat": "csv", ".tsv": "csv"}
SUFFIXES: Mapping[str, Format] = {**_TEXT, ".mat": "mat", ".xlsx": "xlsx", ".xlsm": "xlsx"}
SHEETS = (".xls", ".xlsb", ".ods")


@dataclass(frozen=True)
class Column:
    """A column or field ``name`` written in ``unit``, wanted in ``target``.

    ``positive``: numbers of 0 or below are no readings. ``kind``: what its numbers must be, beside the readings.
    ``rate``: of times, that of the frames per ``target``.
    """

    name: str
    unit: str
    target: str
    positive: bool = False
    kind: Literal["std", "shared", "weight", "place", "mark"] = "std"
    rate: float | None = None


@dataclass(frozen=True)
class TimeStep:
    """Uniform times from zero at the first sample: ``value``, or the file's scalar ``column``."""

    column: Column | None = None
    value: float = 0.0


@dataclass(frozen=True, slots=True)  # of 10⁵ data sets all are in memory
class DataFile:
    """Where one data set is: a file, or of a file that holds several the ``part``, as :func:`parts_of` names it.

    ``others``: where its further series are.
    """

    path: Path
    part: str = ""
    others: "tuple[DataFile, ...]" = ()

    @property
    def paths(self) -> tuple[Path, ...]:
        """The files of all its series, each once."""
        return tuple(dict.fromkeys((self.path, *(path for other in self.others for path in other.paths))))


@dataclass(frozen=True)
class Matrix:
    """A square table of numbers without header in ``unit``, wanted in ``target``."""

    path: Path
    unit: str
    target: str


@dataclass(frozen=True)
class Layout:
    """How a file is laid out: its ``format`` (by default that of the suffix), the ``decimal`` sign of its text, the
    column that says ``by`` which data set a row belongs to, the ``sheet`` of a workbook with or without a range; what
    is done with times that do not increase and with readings that their neighbours refute; from which instant on it
    is read."""

    format: Format | None = None
    decimal: Decimal = "."
    by: str | None = None
    sheet: str = ""
    unsorted: Disorder = "refuse"
    repeated: Repeated = "refuse"
    outliers: Outliers = "keep"
    since: Instant = BY_NAME["start"]


ANY = Layout()


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
