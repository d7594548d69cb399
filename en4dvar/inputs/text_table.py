"""Tables, cells as text: lines, header and numbers of a CSV file or an Excel workbook, and where in it a fault is.

Text is UTF-8, else UTF-16 with its mark or Windows' cp1252. Column names that look alike (µ and μ, composed and
decomposed umlauts, blanks at the ends) are the same.

Numbers of workbooks (``.xlsx``) are those that Excel stored: no formula is evaluated, no macro, link or query is looked
at. A workbook is a zip archive from anybody: what it unpacks to is bounded, and XML that declares entities is refused,
before openpyxl sees it.
"""

import csv
import itertools
import re
import unicodedata
import warnings
import zipfile
from collections.abc import Iterator, Sequence
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from en4dvar.inputs.decimal_sign import Decimal, closed_up, decimal_by, has_comma, is_open, signs_of, without_thousands
from en4dvar.model.state import Array
from en4dvar.plumbing.decoding import Allowed, decoded_whole
from en4dvar.plumbing.errors import DataError
from en4dvar.plumbing.files import read_plain
from en4dvar.plumbing.hints import listed, matches, short, suggest
from en4dvar.plumbing.tables import COMMENT, is_number
from en4dvar.plumbing.units import is_unit

Line = str | Sequence[str]  # of a text, or the cells of a sheet
Lines = Sequence[tuple[int, Line]]
LONGEST = 1_000_000_000  # bytes of a file
WIDEST = 10_000  # columns
BLANK = ("", "nan", "na", "n/a", "#n/a", "-")
MANY = 2000  # lines of a file whose cells are found once, whatever number of series it holds
PREAMBLE = 200  # lines among which the names of the columns are looked for
SEVERAL = 3  # lines of numbers that a table has at least, so that words below them are in its midst
_SCALAR = re.compile(r"(?:#|%|//)\s*([A-Za-z_]\w*)\s*[=:]\s*([-+.\deE]+)(?:\s+(\S.*))?")
_BETWEEN_BLANKS = re.compile(r"\S+", re.ASCII)  # others stand within a cell, between thousands
_BRACKETED = re.compile(r"\[.+\]|\(.+\)")
_NAMELESS = re.compile(r"c[1-9]\d*")


def numbered_lines(path: Path) -> list[tuple[int, str]]:
    """Numbered lines that are neither blank nor comments."""
    lines = enumerate(_text(path).splitlines(), 1)
    return [(n, s) for n, s in lines if s.strip() and not s.lstrip().startswith(COMMENT)]


def remarks_in(path: Path) -> list[int]:
    """The numbers of the comments of a text, none of a sheet, that are no row of numbers, left out by a sign."""
    lines = enumerate((_decoded(read_plain(path, LONGEST)) or "").splitlines(), 1)
    comments = [(n, s.strip().lstrip("#%/ \t")) for n, s in lines if s.lstrip().startswith(COMMENT)]
    signs = [delimiter_of(s, path) for _, s in comments]
    cells = [cells_of(s, sign)[: None if sign else 1] for (_, s), sign in zip(comments, signs, strict=True)]
    return [n for (n, _), own in zip(comments, cells, strict=True) if not _holds_number(own)]


def scalars_in(path: Path) -> dict[str, float]:
    """What comments such as ``# Req = 21.79`` say, by name; ``# delay: 7 us`` is ``delay_us``."""
    said = filter(None, (_SCALAR.fullmatch(line.strip()) for line in _text(path).splitlines()))
    stated = [match.groups() for match in said if is_number(match[2]) and is_unit(match[3] or "1")]
    return {f"{name}_{unit}" if unit else name: float(number) for name, number, unit in stated}


def _text(path: Path) -> str:
    if (text := _decoded(read_plain(path, LONGEST))) is None:
        raise DataError(f"{path}: not a text file")
    return text


@lru_cache(1)  # each series of a file reads it
def _decoded(raw: bytes) -> str | None:
    marked = raw.startswith((b"\xff\xfe", b"\xfe\xff"))
    for encoding in ("utf-16",) if marked else ("utf-8-sig", "cp1252"):
        try:
            text = raw.decode(encoding)
        except UnicodeDecodeError:
            continue
        if not any(unicodedata.category(sign) == "Cc" for sign in {*text} - {*"\t\n\r\f\v\x1a\x85"}):
            return text
    return None


def delimiter_of(line: Line, path: Path) -> str:
    """What separates the cells of a first line; "" for blanks, and of a sheet. Raises :class:`DataError` where it has
    more cells than a table has columns.
    """
    if not isinstance(line, str):
        return ""
    most = max((",", ";", "\t"), key=line.count)
    delimiter = most if most in line else ""
    signs = line.count(delimiter) if delimiter else len(line) // 2
    if signs >= WIDEST and (count := signs + 1 if delimiter else len(line.split())) > WIDEST:
        raise DataError(
            f"{path}: {count} columns; at most {WIDEST} are read; if a line holds one column's numbers, transpose it"
        )
    return delimiter


def cells_of(line: Line, delimiter: str) -> Sequence[str]:
    """The cells of a line, those of a sheet as they are."""
    return _parted(line, delimiter) if isinstance(line, str) else line


@lru_cache(MANY)  # each series of a file has the same lines
def _parted(line: str, delimiter: str) -> Sequence[str]:
    if not delimiter:
        return _BETWEEN_BLANKS.findall(line.strip())
    return [cell.strip() for cell in next(csv.reader([line], delimiter=delimiter, skipinitialspace=True))]


class Table:
    """Columns of a text file or a sheet: their ``names``, and ``rows`` of cells with the numbers of their lines.
    ``every`` one tells the decimal sign, whatever of them is taken for ``rows`` later.

    ``lines`` are numbered lines, of a sheet the cells of each. The names stand in the first line that has all of
    ``wanted`` (names, or patterns with ``*``), else in the one above the numbers; where none does, the columns are
    ``c1``, ``c2``, …. Lines of words directly below the names are no rows; ``units``: by name, where one of
    them, or the line above the names, states units. ``decimal`` holds where the numbers do not tell which sign
    separates thousands.
    """

    def __init__(self, path: Path, decimal: Decimal, wanted: Sequence[str] = (), lines: Lines | None = None):
        self.path, self.decimal = path, decimal
        lines = numbered_lines(path) if lines is None else lines
        if not lines:
            raise DataError(f"{path}: the file holds no data")
        signs = [delimiter_of(line, path) for _, line in lines[:PREAMBLE]]
        head = [cells_of(line, sign) for (_, line), sign in zip(lines, signs, strict=False)]
        top, first = _names_and_numbers(head, signs, wanted)
        self.nameless = top is None
        line = lines[first if top is None else top][1]
        others = (";", "\t") if self.nameless else ()  # numbers may have decimal commas
        delimiter = next((s for s in others if s in line), delimiter_of(line, path))
        self.rows = [(n, cells_of(x, delimiter)) for n, x in lines[first:]]
        below: list[Sequence[str]] = []
        if any(_holds_number(cells) for _, cells in self.rows):
            while _words(self.rows[0][1]):
                below.append(self.rows.pop(0)[1])
        self.every = self.rows
        self.names = [f"c{i + 1}" for i in range(len(self.rows[0][1]))] if top is None else head[top]
        beside = (*below, *(head[top - 1 : top] if top else ()))
        units = next((cells for cells in beside if _are_units(cells, self.names)), ())
        self.units = {name: cell.strip("[]()") for name, cell in zip(self.names, units, strict=False) if _stated(cell)}

    def position(self, name: str) -> int:
        """Which column has this name. Raises :class:`DataError`."""
        alike = [i for i, other in enumerate(self.names) if _same(other, name)]
        if len(alike) == 1:
            return alike[0]
        if self.nameless:
            proposed = ("t_us", "R_um", *self.names[2:])[: len(self.names)]
            hint = f"put one such as {','.join(proposed)!r} there, or call them {listed(self.names, 4)}"
            raise DataError(f"{self.path}: no line above the numbers names the columns: {hint}")
        fault = "more than one column" if alike else "no column"
        raise DataError(f"{self.path}: {fault} {name!r}; the columns are: {listed(self.names)}")

    def numbers(self, i: int, name: str) -> Array:
        """A column as numbers. Raises :class:`DataError`."""
        if not self.rows:
            raise DataError(f"{self.path}: no data: no line follows the header")
        cells = self._cells(self.rows, i)
        signs = self._decimal_signs(i)
        if len(signs) > 1 and (unsure := next((k for k, cell in enumerate(cells) if is_open(cell)), None)) is not None:
            words = "decimals or thousands? other numbers have decimal points, and others commas; write one of the two"
            raise DataError(f"{self.path}:{self.rows[unsure][0]}: {cells[unsure]!r} in column {short(name)!r}: {words}")
        if signs != {"."} or has_comma(cells):
            cells = [without_thousands(cell, decimal_by(cell) or next(iter(signs), None)) for cell in cells]
        numbers = np.empty(len(self.rows))
        for k, (line, _) in enumerate(self.rows):
            try:
                numbers[k] = number_in(cells[k], name, self.path, line, self.decimal)
            except DataError as error:
                raise DataError(f"{error}{self._below(k, i)}") from None
        return numbers

    def unsure(self, i: int) -> str:
        """A number of a column whose comma is that of decimals by ``decimal`` alone; "" where there is none."""
        unsure = next((cell for cell in self._cells(self.rows, i) if "," in cell and is_open(cell)), "")
        return "" if self._decimal_signs(i) else unsure

    def _cells(self, rows: Sequence[tuple[int, Sequence[str]]], i: int) -> list[str]:
        return [closed_up(row[i]) if i < len(row) else "" for _, row in rows]

    def _decimal_signs(self, i: int) -> set[Decimal]:
        """What the numbers of a column tell, else those of all columns."""
        columns = (signs_of(self._cells(self.every, k)) for k in range(len(self.names)))
        return signs_of(self._cells(self.every, i)) or set[Decimal]().union(*columns)

    def _below(self, k: int, i: int) -> str:
        """What to do where row ``k`` repeats the names, ends the numbers of column ``i``, or is words between them."""
        (line, row), (last, _) = self.rows[k], self.rows[-1]
        another = "if another series begins here, give it a file of its own"
        if row == self.names:
            return f"; the line names the columns again: {another}"
        numbers = [_holds_number(row[i : i + 1]) for _, row in self.rows]
        if sum(numbers[:k]) >= len(numbers[k:]) and not any(numbers[k:]):
            return f"; delete {f'line {line}' if line == last else f'lines {line} to {last}'}, below the readings"
        between = any(numbers[:k]) and any(numbers[k:]) and _words(row)
        return f"; nothing in the line is a number: delete it, or {another}" if between else ""


def _names_and_numbers(
    head: Sequence[Sequence[str]], signs: Sequence[str], wanted: Sequence[str]
) -> tuple[int | None, int]:
    """The line that names the columns, None where none does, and the first below it; ``signs`` separate the cells.

    It is the one above the lines with numbers, unless it or one of words above it holds units, which stand below the
    names, as comments stand below units.
    """
    for i, cells in enumerate(head if wanted else ()):
        if all(any(_same(cell, name) or ("*" in name and matches(cell, name)) for cell in cells) for name in wanted):
            return i, i + 1
    first = _first_of_numbers(head, signs)
    if _holds_number(head[first]) and (first == 0 or (wanted and all(map(_NAMELESS.fullmatch, wanted)))):
        return None, first
    top = max(first - 1, 0)
    words = itertools.takewhile(lambda k: k and _words(head[k]) and _words(head[k - 1]), range(top, -1, -1))
    top = next((k - 1 for k in words if _are_units(head[k], head[k - 1])), top)
    if len(head[top]) == 1 < len(head[first]):
        return None, first
    return top, top + 1


def _first_of_numbers(head: Sequence[Sequence[str]], signs: Sequence[str]) -> int:
    """The first of the last lines with numbers between which there are no words but those in the midst of a table.

    Such words stand below lines that have numbers wherever the line below the words has: several, or any where the
    words name no columns, for they are too few or parted by other ``signs``.
    """
    end = next((i for i in reversed(range(len(head))) if _holds_number(head[i])), 0)
    *begins, first = [0, *(i + 1 for i in range(end) if _words(head[i]))]
    stop = first - 1
    for begin in reversed(begins):
        above, own = [_number_columns(cells) for cells in head[begin:stop]], _number_columns(head[first])
        between = [[*filter(_stated, head[k])] for k in range(stop, first) if signs[k] == signs[first]]
        needed = SEVERAL if any(len(cells) >= len(own) for cells in between) else 1
        stop = begin - 1
        if above and (len(above) < needed or not own <= set[int]().union(*above)):
            break
        first = begin if above else first
    return first


def _are_units(cells: Sequence[str], names: Sequence[str]) -> bool:
    """Whether at least half of what a line of words states of so many columns with names are units."""
    stated = [i for i, cell in enumerate(cells) if _stated(cell)]
    units = [i for i in stated if is_unit(cells[i]) or _BRACKETED.fullmatch(cells[i])]
    named = len(cells) <= len(names) and all(_stated(names[i]) for i in stated)
    return named and 2 * len(units) >= len(stated) > 0


def _stated(cell: str) -> bool:
    return cell.lower() not in BLANK


def _number_columns(cells: Sequence[str]) -> set[int]:
    return {i for i, cell in enumerate(cells) if _holds_number([cell])}


def _holds_number(cells: Sequence[str]) -> bool:
    shut = map(closed_up, filter(_stated, cells))
    return any(is_number(cell.replace(",", ".")) or decimal_by(cell) for cell in shut)


def _words(cells: Sequence[str]) -> bool:
    return not _holds_number(cells) and any(map(_stated, cells))


def _same(a: str, b: str) -> bool:
    return unicodedata.normalize("NFKC", a).strip() == unicodedata.normalize("NFKC", b).strip()


def number_in(cell: str, name: str, path: Path, line: int, decimal: Decimal | None) -> float:
    """A cell as a number, NaN where it is blank; ``decimal`` None: a point, without a word on the setting."""
    if cell.lower() in BLANK:
        return float("nan")
    try:
        return float(cell.replace(",", ".") if decimal == "," and "." not in cell else cell)
    except ValueError:
        comma = decimal != "," and "," in cell and _holds_number([cell])
    hint = "; write a decimal point" + (", or data.decimal: ','" if decimal else "") if comma else ""
    hint += "; if the comma separates thousands, delete it" if comma and is_open(cell) else ""
    raise DataError(f"{path}:{line}: {short(cell)!r} in column {short(name)!r} is not a number{hint}")


if TYPE_CHECKING:
    from openpyxl.worksheet._read_only import ReadOnlyWorksheet

LARGEST = 1 << 28  # bytes that the parts of a workbook unpack to
MOST_PARTS = 2_000
DECLARATION = [bytes("<!D", c) for c in ("utf-8", "utf-16-le", "utf-16-be")]  # of entities, in XML
MOST_CELLS = 10_000_000
WORKBOOK = Allowed(seconds=60, memory=4_000_000_000, size=LARGEST)
MOST_ROWS = 1 << 20  # of a sheet: what Excel itself allows
_RANGE = re.compile(r"\$?[A-Za-z]{1,3}\$?[1-9]\d{0,6}(:\$?[A-Za-z]{1,3}\$?[1-9]\d{0,6})?")


def sheet_lines(path: Path, asked: str) -> Lines:
    """Rows of a sheet that are not blank, with their numbers; ``asked`` is a sheet, ``Sheet!A3:D40`` or ``A3:D40``.
    Raises :class:`DataError`.
    """
    return decoded_whole(lines_of_workbook, path, asked, allowed=WORKBOOK, kind="a workbook (save it as CSV)")


def lines_of_workbook(path: Path, asked: str) -> Iterator[Lines]:
    """As :func:`sheet_lines`, in the child that decodes."""
    name, area = _parts(asked)
    _check(path)
    stored = _rows(path, name, area, formulas=False)
    if any(None in cells for _, cells in stored):
        _refuse_formulas(path, stored, _rows(path, name, area, formulas=True))
    yield [(number, texts) for number, cells in stored if (texts := _texts(cells))]


def _parts(asked: str) -> tuple[str, str]:
    """Name of the sheet and the range, "" where it is not said."""
    name, _, area = asked.rpartition("!")
    if _RANGE.fullmatch(area):
        return name.strip("'"), area.upper().replace("$", "")
    return asked.strip("'"), ""


def _check(path: Path) -> None:
    """Raise :class:`DataError` where the archive is not to be unpacked; what zipfile raises where it is none."""
    with zipfile.ZipFile(path) as archive:
        parts = archive.infolist()
        size = sum(part.file_size for part in parts)
        if size > LARGEST or len(parts) > MOST_PARTS:
            raise DataError(f"{path}: {len(parts)} parts that unpack to {size / 2**20:.0f} MiB; save it as CSV")
        for part in parts:
            xml = archive.read(part) if part.filename.endswith((".xml", ".rels")) else b""
            if any(sign in xml for sign in DECLARATION):
                raise DataError(f"{path}: {part.filename} declares entities, as no workbook does")


def _rows(path: Path, name: str, area: str, formulas: bool) -> list[tuple[int, tuple[Any, ...]]]:
    try:
        from openpyxl import load_workbook
        from openpyxl.utils import range_boundaries
    except ImportError:
        raise DataError(f"{path}: Excel needs: pip install openpyxl; or save the sheet as CSV") from None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of styles and extensions that openpyxl leaves out
        book = load_workbook(path, read_only=True, data_only=not formulas, keep_links=False)
        try:
            sheet = _sheet(book, name, path)
            sheet.reset_dimensions()  # the stated ones may be wrong
            keys = ("min_col", "min_row", "max_col", "max_row")
            bounds: dict[str, int] = dict(zip(keys, range_boundaries(area), strict=True)) if area else {}
            rows, count = [], 0
            for number, cells in enumerate(sheet.iter_rows(**bounds, values_only=True), bounds.get("min_row", 1)):
                if number > MOST_ROWS or len(cells) > WIDEST:
                    raise DataError(f"{path}: more than {MOST_ROWS} rows or {WIDEST} columns in sheet {sheet.title!r}")
                count += len(cells) + 1
                if count > MOST_CELLS:
                    raise DataError(f"{path}: more than {MOST_CELLS} cells in sheet {sheet.title!r}, with blank ones")
                rows.append((number, cells))
            return rows
        finally:
            book.close()


def _sheet(book: Any, name: str, path: Path) -> "ReadOnlyWorksheet":
    """The sheet of a name, or the only one with anything in it. Raises :class:`DataError`."""
    sheets = {sheet.title: sheet for sheet in book.worksheets}
    if name:
        if name not in sheets:
            raise DataError(f"{path}: no sheet {name!r}{suggest(name, sheets)}")
        return sheets[name]
    used = [sheet for sheet in sheets.values() if any(map(_texts, sheet.iter_rows(values_only=True)))]
    if len(used) != 1:
        which = f"{len(used)} sheets hold something; say which (data.sheet): {listed(sheet.title for sheet in used)}"
        raise DataError(f"{path}: {which if used else 'none holds anything'}")
    return used[0]


def _texts(cells: tuple[Any, ...]) -> list[str]:
    """Cells as text, without the blank ones at the end."""
    texts = ["" if cell is None else _text_of(cell) for cell in cells]
    while texts and not texts[-1]:
        texts.pop()
    return texts


def _text_of(cell: Any) -> str:
    """A cell as text; a number so that its point separates no thousands."""
    if not isinstance(cell, float):
        return str(cell).strip()
    return f"{cell!r}0" if is_open(repr(cell)) else repr(cell)


def _refuse_formulas(path: Path, stored: Any, written: Any) -> None:
    """Raise :class:`DataError` where a formula has no stored value, which would read as a blank cell."""
    from openpyxl.utils import get_column_letter

    for (number, values), (_, texts) in zip(stored, written, strict=False):
        for i, (value, text) in enumerate(zip(values, texts, strict=False)):
            if value is None and isinstance(text, str) and text.startswith("="):
                where = f"{get_column_letter(i + 1)}{number}"
                words = f"cell {where} holds a formula without a stored value, and none is evaluated; open and save"
                raise DataError(f"{path}:{number}: {words} the workbook in Excel or LibreOffice, or save it as CSV")
