"""Tables as text: aligned for the terminal, or CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence


def table(rows: Sequence[Sequence[str]]) -> str:
    """Rows of cells as aligned columns; the first row is the header."""
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    return "\n".join("  ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)).rstrip() for row in rows)


def csv_text(rows: Iterable[Sequence[object]]) -> str:
    """Rows of cells as CSV; of numbers every digit is kept."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()
