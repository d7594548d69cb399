"""Tables as text: lines, header and numbers of a CSV file, and where in it a fault is.

Text is UTF-8, else UTF-16 with its mark or Windows' cp1252. Column names that look alike (µ and μ, composed and
decomposed umlauts) are the same.
"""

from __future__ import annotations

import csv
import unicodedata
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from en4dvar.errors import DataError

Decimal = Literal[".", ","]
COMMENT = ("#", "%", "//")
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


def read_header(path: Path, lines: Sequence[tuple[int, str]]) -> tuple[list[str], str]:
    """Names of the columns and what separates them."""
    if not lines:
        raise DataError(f"{path}: the file holds no data")
    delimiter = delimiter_of(lines[0][1])
    names = cells_of(lines[0][1], delimiter)
    if all(_is_number(n.replace(",", ".")) for n in names):
        line = (delimiter or " ").join(("t_us", "R_um", *(f"c{i}" for i in range(3, len(names) + 1)))[: len(names)])
        raise DataError(
            f"{path}: the first line must name the columns, but it holds numbers; put a line such as {line!r} above it"
        )
    return names, delimiter


def second_header(rows: Sequence[tuple[int, list[str]]]) -> str:
    """What to do about a first row without any number, as one of units is."""
    words = rows and not any(_is_number(cell.replace(",", ".")) for cell in rows[0][1])
    return "; if this is no reading, put # before the line" if words else ""


def delimiter_of(line: str) -> str:
    """What separates the cells; "" for blanks."""
    delimiter = max((",", ";", "\t"), key=line.count)
    return delimiter if delimiter in line else ""


def cells_of(line: str, delimiter: str) -> list[str]:
    if not delimiter:
        return line.split()
    return [cell.strip() for cell in next(csv.reader([line], delimiter=delimiter, skipinitialspace=True))]


def position(path: Path, names: list[str], name: str, lines: Sequence[tuple[int, str]]) -> int:
    alike = [i for i, other in enumerate(names) if _same(other, name)]
    if len(alike) == 1:
        return alike[0]
    fault = "more than one column" if alike else "no column"
    below = [n for n, line in lines[1:] if any(_same(cell, name) for cell in cells_of(line, delimiter_of(line)))]
    hint = f"; line {below[0]} names it: put # before the lines above" if below and not alike else ""
    raise DataError(f"{path}: {fault} {name!r}; the columns are: {', '.join(names)}{hint}")


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
        raise DataError(f"{path}:{line}: {cell!r} in column {name!r} is not a number{hint}")
    return float(text)
