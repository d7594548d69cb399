"""What the page and the terminal say of how a posterior responds to its assumptions: rows and sentences."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

from markupsafe import Markup

from en4dvar.report.text import fixed, number_like, pretty_unit, symbol_html
from en4dvar.storage.responses import StoredShift, stored_ledger, stored_shifts
from en4dvar.storage.store import StoredResult

Lines = list[tuple[object, ...]]


def shift_text(shift: StoredShift) -> str:
    """``"+15 %"``, or in the parameter's unit where its value may be negative, as fine as its error bar is.

    An en dash where it is not known.
    """
    value, unit = shift.change, pretty_unit(shift.unit)
    if math.isfinite(shift.relative):
        value, unit = 100 * shift.relative, "%"
    bar = abs(value / shift.in_std) if shift.in_std else math.nan
    text = f"{number_like(value, bar)} {unit}".strip() if math.isfinite(value) else "–"
    return text if value <= 0 or not math.isfinite(value) else f"+{text}"


def sentence(shifts: Sequence[StoredShift], symbol: bool = False) -> str:
    """What an alternative would do to the parameters that it moves beyond their error bar."""
    first = shifts[0]
    if first.reason:
        return f"if {first.words}, the posterior cannot be told without another fit ({first.reason})"
    moved = sorted((s for s in shifts if s.exceeds), key=lambda s: -abs(s.in_std))
    name = (lambda s: symbol_html(s.symbol)) if symbol else (lambda s: s.parameter)
    parts = [
        Markup("{} would be {} {} ({} times its error bar)").format(
            name(s),
            shift_text(s).lstrip("+−"),
            "higher" if s.change > 0 else "lower",
            fixed(abs(s.in_std), 1),
        )
        for s in moved
    ]
    return Markup("if {}, {}").format(first.words, Markup(", ").join(parts))


def exceeding(rows: Iterable[Sequence[StoredShift]]) -> list[Sequence[StoredShift]]:
    """The alternatives that move a parameter beyond its error bar."""
    return [row for row in rows if any(shift.exceeds for shift in row)]


def response_lines(result: StoredResult) -> tuple[Lines, Lines]:
    """Lines of ``what_if.csv`` and of ``ledger.csv``, the name of the data set first."""
    return (
        [(result.name, *shift.cells) for row in stored_shifts(result) for shift in row],
        [(result.name, *entry.cells) for row in stored_ledger(result) for entry in row],
    )
