"""Tables as text: lines, header and numbers of a CSV file, and where in it a fault is.

Text is UTF-8, else UTF-16 with its mark or Windows' cp1252. Column names that look alike (µ and μ, composed and
decomposed umlauts) are the same.
"""

from __future__ import annotations

import csv
import unicodedata
from pathlib import Path
from typing import Literal

import numpy as np

from en4dvar.errors import DataError
from en4dvar.hints import listed, short
from en4dvar.state import Array

Decimal = Literal[".", ","]
COMMENT = ("#", "%", "//")
WIDEST = 10_000  # columns
BLANK = ("", "nan", "na", "n/a", "-")


def numbered_lines(path: Path) -> list[tuple[int, str]]:
    """Numbered lines that are neither blank nor comments."""
    lines = enumerate(_text(path).splitlines(), 1)
    return [(n, s) for n, s in lines if s.strip() and not s.lstrip().startswith(COMMENT)]


def _text(path: Path) -> str:
    raw = path.read_bytes()
    marked = raw.startswith((b"\xff\xfe", b"\xfe\xff"))
    for encoding in ("utf-16",) if marked else ("utf-8-sig", "cp1252"):
        try:
            text = raw.decode(encoding)
        except UnicodeDecodeError:
            continue
        if not any(unicodedata.category(sign) == "Cc" for sign in {*text} - {*"\t\n\r\f\v\x1a\x85"}):
            return text
    raise DataError(f"{path}: not a text file")


def delimiter_of(line: str) -> str:
    """What separates the cells; "" for blanks."""
    delimiter = max((",", ";", "\t"), key=line.count)
    return delimiter if delimiter in line else ""


def check_width(line: str, delimiter: str, path: Path) -> None:
    """Raise :class:`DataError` where a first line has more cells than a table has columns."""
    signs = line.count(delimiter) if delimiter else len(line) // 2
    if signs >= WIDEST and (count := signs + 1 if delimiter else len(line.split())) > WIDEST:
        raise DataError(
            f"{path}: {count} columns; at most {WIDEST} are read; if a line holds one column's numbers, transpose it"
        )


def cells_of(line: str, delimiter: str) -> list[str]:
    if not delimiter:
        return line.split()
    return [cell.strip() for cell in next(csv.reader([line], delimiter=delimiter, skipinitialspace=True))]


class Table:
    """A CSV file: ``names`` of the columns, and ``rows`` of cells with the numbers of their lines."""

    def __init__(self, path: Path, decimal: Decimal):
        self.path, self.decimal, lines = path, decimal, numbered_lines(path)
        if not lines:
            raise DataError(f"{path}: the file holds no data")
        (_, header), *self.lines = lines
        delimiter = delimiter_of(header)
        check_width(header, delimiter, path)
        self.names = cells_of(header, delimiter)
        if all(_is_number(name.replace(",", ".")) for name in self.names):
            proposed = ("t_us", "R_um", *(f"c{i}" for i in range(3, len(self.names) + 1)))[: len(self.names)]
            raise DataError(
                f"{path}: the first line must name the columns, but it holds numbers; put a line such as "
                f"{(delimiter or ' ').join(proposed)!r} above it"
            )
        self.rows = [(number, cells_of(line, delimiter)) for number, line in self.lines]

    def position(self, name: str) -> int:
        """Which column has this name. Raises :class:`DataError`."""
        alike = [i for i, other in enumerate(self.names) if _same(other, name)]
        if len(alike) == 1:
            return alike[0]
        fault = "more than one column" if alike else "no column"
        below = [n for n, line in self.lines if any(_same(cell, name) for cell in cells_of(line, delimiter_of(line)))]
        hint = f"; line {below[0]} names it: put # before the lines above" if below and not alike else ""
        raise DataError(f"{self.path}: {fault} {name!r}; the columns are: {listed(self.names)}{hint}")

    def numbers(self, i: int, name: str) -> Array:
        """A column as numbers. Raises :class:`DataError`, which tells what to do about a second header."""
        found: list[float] = []
        for row, (line, cells) in enumerate(self.rows):
            try:
                found.append(number_in(cells[i] if i < len(cells) else "", name, self.path, line, self.decimal))
            except DataError as error:
                words = row == 0 and not any(_is_number(cell.replace(",", ".")) for cell in cells)
                hint = "; if this is no reading, put # before the line" if words else ""
                raise DataError(f"{error}{hint}") from None
        return np.array(found, dtype=float)


def _same(a: str, b: str) -> bool:
    return unicodedata.normalize("NFKC", a) == unicodedata.normalize("NFKC", b)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def number_in(cell: str, name: str, path: Path, line: int, decimal: Decimal | None) -> float:
    """A cell as a number, NaN where it is blank; ``decimal`` None: a point, without a word on the setting."""
    if cell.lower() in BLANK:
        return float("nan")
    text = cell.replace(",", ".") if decimal == "," and "." not in cell else cell
    if not _is_number(text):
        comma = decimal != "," and "," in cell and _is_number(cell.replace(",", "."))
        hint = "; write a decimal point" + (", or data.decimal: ','" if decimal else "") if comma else ""
        raise DataError(f"{path}:{line}: {short(cell)!r} in column {short(name)!r} is not a number{hint}")
    return float(text)
