"""Tables of Excel workbooks (``.xlsx``), cells as text.

Numbers are those that Excel stored: no formula is evaluated, no macro, link or query is looked at. A workbook is a zip
archive from anybody: what it unpacks to is bounded, and XML that declares entities is refused, before openpyxl sees it.
"""

from __future__ import annotations

import re
import warnings
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from en4dvar.inputs.text_table import WIDEST, Lines
from en4dvar.plumbing.decoding import Allowed, decoded_whole
from en4dvar.plumbing.errors import DataError
from en4dvar.plumbing.hints import listed, suggest

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
    return decoded_whole(lines_of_workbook, path, asked, allowed=WORKBOOK)


def lines_of_workbook(path: Path, asked: str) -> Iterator[Lines]:
    """As :func:`sheet_lines`, in the child that decodes."""
    name, area = _parts(asked)
    _check(path)
    try:
        stored = _rows(path, name, area, formulas=False)
        rows = [(number, _texts(cells)) for number, cells in stored]
        if any(None in cells for _, cells in stored):
            _refuse_formulas(path, stored, _rows(path, name, area, formulas=True))
    except (DataError, MemoryError):
        raise
    except Exception as error:  # whatever openpyxl stumbles over: it trusts what is in the archive
        raise DataError(f"{path}: not a workbook that can be read ({type(error).__name__}); save it as CSV") from None
    yield [(number, cells) for number, cells in rows if cells]


def _parts(asked: str) -> tuple[str, str]:
    """Name of the sheet and the range, "" where it is not said."""
    name, _, area = asked.rpartition("!")
    if _RANGE.fullmatch(area):
        return name.strip("'"), area.upper().replace("$", "")
    return asked.strip("'"), ""


def _check(path: Path) -> None:
    """Raise :class:`DataError` where the archive is none, or not to be unpacked."""
    try:
        with zipfile.ZipFile(path) as archive:
            parts = archive.infolist()
            size = sum(part.file_size for part in parts)
            if size > LARGEST or len(parts) > MOST_PARTS:
                raise DataError(f"{path}: {len(parts)} parts that unpack to {size / 2**20:.0f} MiB; save it as CSV")
            for part in parts:
                xml = archive.read(part) if part.filename.endswith((".xml", ".rels")) else b""
                if any(sign in xml for sign in DECLARATION):
                    raise DataError(f"{path}: {part.filename} declares entities, as no workbook does")
    except DataError:
        raise
    except Exception as error:  # BadZipFile, zlib.error and whatever else a damaged archive gives
        raise DataError(f"{path}: not an Excel workbook ({error})") from None


def _rows(path: Path, name: str, area: str, formulas: bool) -> list[tuple[int, tuple[Any, ...]]]:
    """Numbered rows of cells."""
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


def _sheet(book: Any, name: str, path: Path) -> ReadOnlyWorksheet:
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
    texts = ["" if cell is None else repr(cell) if isinstance(cell, float) else str(cell).strip() for cell in cells]
    while texts and not texts[-1]:
        texts.pop()
    return texts


def _refuse_formulas(path: Path, stored: Any, written: Any) -> None:
    """Raise :class:`DataError` where a formula has no stored value, which would read as a blank cell."""
    from openpyxl.utils import get_column_letter

    for (number, values), (_, texts) in zip(stored, written, strict=False):
        for i, (value, text) in enumerate(zip(values, texts, strict=False)):
            if value is None and isinstance(text, str) and text.startswith("="):
                where = f"{get_column_letter(i + 1)}{number}"
                raise DataError(
                    f"{path}:{number}: cell {where} holds a formula without a stored value, and none is evaluated; "
                    "open and save the workbook in Excel or LibreOffice, or save the sheet as CSV"
                )
