"""What is asked of a data file: which columns in which units, how it is laid out, which of its parts."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from en4dvar.inputs.text_table import Decimal
from en4dvar.inputs.window import BY_NAME, Instant

Format = Literal["csv", "mat", "xlsx"]
Disorder = Literal["refuse", "sort"]
Repeated = Literal["refuse", "average"]
Outliers = Literal["keep", "leave out"]
_TEXT: Mapping[str, Format] = {".csv": "csv", ".txt": "csv", ".dat": "csv", ".tsv": "csv"}
SUFFIXES: Mapping[str, Format] = {**_TEXT, ".mat": "mat", ".xlsx": "xlsx", ".xlsm": "xlsx"}


@dataclass(frozen=True)
class Column:
    """A column or field ``name`` written in ``unit``, wanted in ``target``.

    ``positive``: zeros before its first reading are none. ``kind``: what its numbers must be, beside the readings.
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
