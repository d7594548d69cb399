"""Tables as text: aligned for the terminal, or CSV."""

import csv
import io
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import IO, Any

from en4dvar.plumbing.files import atomic_path

_CONTROL = re.compile(r"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f]")  # but for tabs and ends of lines
COMMENT = ("#", "%", "//")  # begins a line of text that is none of a table
_FORMULA = tuple("=+-@＝＋－＠")  # a spreadsheet evaluates a cell that begins so; in wide characters as well


def table(rows: Sequence[Sequence[str]]) -> str:
    """Rows of cells as aligned columns; the first row is the header."""
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    return "\n".join("  ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)).rstrip() for row in rows)


def csv_text(rows: Iterable[Sequence[object]]) -> str:
    """Rows of cells as CSV; of numbers every digit is kept. Text that a spreadsheet would take for a formula begins
    with an apostrophe: names come from files of anybody.
    """
    text = io.StringIO()
    _write(text, rows)
    return text.getvalue()


def write_csv(path: Path, rows: Iterable[Sequence[object]]) -> Path:
    """The text of :func:`csv_text` as a file, without having it in memory. Raises :class:`OutputError`."""
    with atomic_path(path) as partial, partial.open("w", encoding="utf-8", newline="") as file:
        _write(file, rows)
    return path


def _write(file: IO[str], rows: Iterable[Sequence[object]]) -> None:
    plain = ([_plain(cell) if isinstance(cell, str) else cell for cell in row] for row in rows)
    csv.writer(file, lineterminator="\n").writerows(plain)


def without_control(text: str) -> str:
    r"""Text without what a terminal that shows the file would obey: names come from files of anybody.

    >>> without_control("a\x1b[2Jb")
    'a\\x1b[2Jb'
    """
    return _CONTROL.sub(lambda sign: repr(sign[0])[1:-1], text)


def _plain(cell: str) -> str:
    """A cell that is no formula: text as it is, or behind an apostrophe; without the line breaks of old.

    >>> _plain("=1+1"), _plain("-a"), _plain("-1.5"), _plain("a=b")
    ("'=1+1", "'-a", '-1.5', 'a=b')
    """
    cell = without_control(cell.replace("\r", " "))  # csv does not quote it, and a new line begins there
    if not (cell[:1] in ("\t", "\n") or cell.lstrip()[:1] in _FORMULA):
        return cell
    return cell if is_number(cell) else f"'{cell}"


def unescaped(cell: str) -> str:
    """The text that :func:`csv_text` wrote as this cell.

    >>> unescaped("'-a"), unescaped("'a")
    ('-a', "'a")
    """
    return cell[1:] if cell[:1] == "'" and _plain(cell[1:]) == cell else cell


def is_number(cell: Any) -> bool:
    """Whether ``float`` takes it."""
    try:
        float(cell)
    except (TypeError, ValueError):
        return False
    return True
