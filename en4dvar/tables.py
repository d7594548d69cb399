"""Tables as text: aligned for the terminal, or CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence

_FORMULA = tuple("=+-@＝＋－＠")  # a spreadsheet evaluates a cell that begins so; in wide characters as well


def table(rows: Sequence[Sequence[str]]) -> str:
    """Rows of cells as aligned columns; the first row is the header."""
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    return "\n".join("  ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)).rstrip() for row in rows)


def csv_text(rows: Iterable[Sequence[object]]) -> str:
    """Rows of cells as CSV; of numbers every digit is kept.

    Text that a spreadsheet would take for a formula begins with an apostrophe: names come from files of anybody.
    """
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([_plain(cell) for cell in row] for row in rows)
    return text.getvalue()


def _plain(cell: object) -> object:
    """A cell that is no formula: text as it is, or behind an apostrophe; without the line breaks of old.

    >>> _plain("=1+1"), _plain("-a"), _plain("-1.5"), _plain("a=b"), _plain(-1.5)
    ("'=1+1", "'-a", '-1.5', 'a=b', -1.5)
    """
    if not isinstance(cell, str):
        return cell
    cell = cell.replace("\r", " ")  # csv does not quote it, and a new line begins there
    if not (cell[:1] in ("\t", "\n") or cell.lstrip()[:1] in _FORMULA):
        return cell
    try:
        float(cell)
    except ValueError:
        return f"'{cell}"
    return cell
