"""How a posterior responds to its assumptions, read from a result: rows of tables, sentences of the page."""

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from markupsafe import Markup

from en4dvar.report.text import fixed, number_like, pretty_unit, shown, symbol_html
from en4dvar.results.store import StoredResult

SHIFT_COLUMNS = (
    "alternative", "if", "parameter", "unit", "change", "relative_change", "change_in_std", "cost_change", "reason",
)  # fmt: skip

ENTRY_COLUMNS = ("parameter", "quantity", "unit", "q05", "q50", "q95")


class StoredShift(NamedTuple):
    """What one parameter would do under one alternative: ``change`` in ``unit``, the display unit.

    ``relative``: of the value, NaN where that may be negative. ``reason``: why linear response does not tell, or "".
    Behind the cells of :data:`SHIFT_COLUMNS`, the symbol of the parameter.
    """

    alternative: str
    words: str
    parameter: str
    unit: str
    change: float
    relative: float
    in_std: float
    cost_change: float
    reason: str
    symbol: str

    @property
    def exceeds(self) -> bool:
        """Whether it is more than the parameter's standard deviation."""
        return abs(self.in_std) > 1


class StoredEntry(NamedTuple):
    """Where on the path one parameter was informed, in one quantity: ``low``, ``median``, ``high`` are 5, 50, 95 %.

    Behind the cells of :data:`ENTRY_COLUMNS`, the symbol of the parameter and the label of the quantity.
    """

    parameter: str
    quantity: str
    unit: str
    low: float
    median: float
    high: float
    symbol: str
    label: str


def stored_ledger(result: StoredResult) -> tuple[tuple[StoredEntry, ...], ...]:
    """A row a parameter that acts along the path, in it one entry a quantity of the path; display units."""
    stats, about = result.groups["/sample_stats"], {name: v.attrs for name, v in result.parameters.items()}
    if "ledger_weight" not in stats.variables:
        return ()
    ending = "_quantiles"
    quantities = [name.removesuffix(ending) for name in stats.variables if name.endswith(ending)]

    def entry(i: int, parameter: str, quantity: str) -> StoredEntry:
        v = stats.variables[quantity + ending]
        low, median, high = shown(v)[i].tolist()
        name, symbol, label = quantity.removeprefix("ledger_"), about[parameter]["symbol"], v.attrs["long_name"]
        return StoredEntry(parameter, name, v.attrs["display_units"], low, median, high, symbol, label)

    names = list(map(str, stats.coords["path_parameter"].values))
    return tuple(tuple(entry(i, name, q) for q in quantities) for i, name in enumerate(names))


def stored_shifts(result: StoredResult) -> tuple[tuple[StoredShift, ...], ...]:
    """A row an alternative, in it one shift a parameter; the largest first, then those unknown, then small ones."""
    stats = result.groups["/sample_stats"]
    if "what_if_change" not in stats.variables:
        return ()
    of = {key: stats.variables[f"what_if_{key}"].values for key in ("words", "cost_change", "reason")}
    change, relative, in_std = (
        stats.variables[f"what_if_{key}"].values for key in ("change", "relative_change", "change_in_std")
    )
    parameters, alternatives = result.parameters, stats.coords["alternative"].values

    def shift(i: int, j: int, name: str) -> StoredShift:
        about, value = parameters[name].attrs, float(shown(parameters[name], change[i, j]))
        numbers = value, float(relative[i, j]), float(in_std[i, j]), float(of["cost_change"][i])
        known = str(alternatives[i]), str(of["words"][i]), name, about["display_units"]
        return StoredShift(*known, *numbers, str(of["reason"][i]), about["symbol"])

    largest = np.where(of["reason"] == "", np.abs(in_std).max(axis=1), 1.0)
    order = np.argsort(-largest, kind="stable").tolist()
    return tuple(tuple(shift(i, j, name) for j, name in enumerate(parameters)) for i in order)


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


def sentence(shifts: Sequence[StoredShift]) -> str:
    """What an alternative would do to the parameters that it moves beyond their error bar."""
    first = shifts[0]
    if first.reason:
        words = "the numbers may change by more than their error bars; a fit with it tells"
        return f"if {first.words}, {words} ({first.reason})"
    moved = sorted((s for s in shifts if s.exceeds), key=lambda s: -abs(s.in_std))
    parts = [
        Markup("{} would be {} {} ({} times its error bar)").format(
            symbol_html(s.symbol),
            shift_text(s).lstrip("+−"),
            "higher" if s.change > 0 else "lower",
            fixed(abs(s.in_std), 1),
        )
        for s in moved
    ]
    return Markup("if {}, {}").format(first.words, Markup(", ").join(parts))


def exceeding(rows: Iterable[Sequence[StoredShift]]) -> list[Sequence[StoredShift]]:
    """The alternatives that move a parameter beyond its error bar, or may."""
    return [row for row in rows if row[0].reason or any(shift.exceeds for shift in row)]
