"""How a posterior responds, in a result file: shifts under the model's alternatives, and the ledger; written and read."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from en4dvar.analysis import Analysis
from en4dvar.response.ledger import QUANTILES
from en4dvar.storage.netcdf import Variable, variable
from en4dvar.units import convert

if TYPE_CHECKING:
    from en4dvar.storage.store import StoredResult

ALTERNATIVE = ("alternative", "parameter")
SHIFT_COLUMNS = (
    "alternative", "if", "parameter", "unit", "change", "relative_change", "change_in_std", "cost_change", "reason",
)  # fmt: skip

ENTRY_COLUMNS = ("parameter", "quantity", "unit", "q05", "q50", "q95")


@dataclass(frozen=True)
class StoredShift:
    """What one parameter would do under one alternative: ``change`` in ``unit``, the display unit.

    ``relative``: of the value, NaN where that may be negative. ``reason``: why linear response does not tell, or "".
    """

    alternative: str
    words: str
    parameter: str
    symbol: str
    unit: str
    change: float
    relative: float
    in_std: float
    cost_change: float
    reason: str

    @property
    def exceeds(self) -> bool:
        """Whether it is more than the parameter's standard deviation."""
        return abs(self.in_std) > 1

    @property
    def cells(self) -> tuple[object, ...]:
        """In the order of :data:`SHIFT_COLUMNS`."""
        numbers = (self.change, self.relative, self.in_std, self.cost_change)
        return (self.alternative, self.words, self.parameter, self.unit, *numbers, self.reason)


def response_coordinates(a: Analysis) -> dict[str, Variable]:
    """Of the dimensions of :func:`response_variables`."""
    found = {}
    if a.what_if:
        names = _text(shift.name for shift in _in_order(a))
        found["alternative"] = variable("alternative", names, "1", "assumption that could be otherwise", fill=False)
    if a.ledger is not None:
        names = _text(a.ledger.parameters)
        found["path_parameter"] = variable("path_parameter", names, "1", "acts along the path", fill=False)
        found["quantile"] = variable("quantile", QUANTILES, "1", "quantile under the weights", fill=False)
    return found


def response_variables(a: Analysis) -> dict[str, Variable]:
    """Variables of ``sample_stats``; none where the model offers neither alternatives nor quantities of its path."""
    return {**_of_shifts(a), **_of_ledger(a)}


def _of_ledger(a: Analysis) -> dict[str, Variable]:
    if a.ledger is None:
        return {}
    book, model = a.ledger, a.problem.model
    of_cell = ("path_parameter", "path_cell")
    edges = np.column_stack([book.edges[:-1], book.edges[1:]])
    times = {"display_units": model.time_display_unit}
    found = {
        "ledger_time": variable(("path_cell", "path_edge"), edges, model.time_unit, "begin and end of the cell", **times),
        "ledger_weight": variable(of_cell, book.weights, "1", "share of the cell in what informed the parameter"),
        "ledger_kernel": variable(of_cell, book.kernel, "1", "averaging kernel of the estimate over the cell"),
    }
    for i, q in enumerate(book.quantities):
        about = {"display_units": q.display_unit, "symbol": q.symbol}
        name, of_quantiles = f"ledger_{q.name}", book.quantiles[:, i]
        found[name] = variable("path_cell", book.values[i], q.unit, f"{q.label}, mean size in the cell", **about)
        found[f"{name}_quantiles"] = variable(("path_parameter", "quantile"), of_quantiles, q.unit, q.label, **about)
    return found


def _of_shifts(a: Analysis) -> dict[str, Variable]:
    if not a.what_if:
        return {}
    shifts = _in_order(a)
    change, in_std = np.stack([s.change for s in shifts]), np.stack([s.in_std for s in shifts])
    relative = np.stack([s.relative for s in shifts])
    runs = [s.runs for s in shifts]
    each = "each in the unit of its parameter"
    return {
        "what_if_words": variable("alternative", _text(s.words for s in shifts), "1", "if …"),
        "what_if_change": variable(ALTERNATIVE, change, "1", f"change of the centre under the alternative, {each}"),
        "what_if_relative_change": variable(ALTERNATIVE, relative, "1", "the same relative to the centre"),
        "what_if_change_in_std": variable(ALTERNATIVE, in_std, "1", "the same in posterior standard deviations"),
        "what_if_cost_change": variable("alternative", [s.cost_change for s in shifts], "1", "change of J"),
        "what_if_runs_each": variable("alternative", runs, "1", "forward runs it took"),
        "what_if_reason": variable("alternative", _text(s.reason for s in shifts), "1", "why it cannot be told"),
    }


def stored_shifts(result: StoredResult) -> tuple[tuple[StoredShift, ...], ...]:
    """A row an alternative, in it one shift a parameter; the alternatives that exceed the error bar most first."""
    stats = result.sample_stats
    if "what_if_change" not in stats:
        return ()
    of = {key: stats[f"what_if_{key}"].values for key in ("words", "cost_change", "reason")}
    change, relative, in_std = (stats[f"what_if_{key}"].values for key in ("change", "relative_change", "change_in_std"))
    names, abouts = list(map(str, result.posterior)), [v.attrs for v in result.posterior.data_vars.values()]

    def row(i: int, alternative: str) -> tuple[StoredShift, ...]:
        common = float(of["cost_change"][i]), str(of["reason"][i])
        return tuple(
            StoredShift(
                alternative,
                str(of["words"][i]),
                name,
                about["symbol"],
                about["display_units"],
                convert(float(change[i, j]), about["units"], about["display_units"]),
                float(relative[i, j]),
                float(in_std[i, j]),
                *common,
            )
            for j, (name, about) in enumerate(zip(names, abouts, strict=True))
        )

    largest = np.where(of["reason"] == "", np.abs(in_std).max(axis=1), np.inf)
    return tuple(row(i, str(stats["alternative"].values[i])) for i in np.argsort(-largest, kind="stable"))


@dataclass(frozen=True)
class StoredEntry:
    """Where on the path one parameter was informed, in one quantity: ``low``, ``median``, ``high`` are 5, 50, 95 %."""

    parameter: str
    symbol: str
    quantity: str
    label: str
    unit: str
    low: float
    median: float
    high: float

    @property
    def cells(self) -> tuple[object, ...]:
        """In the order of :data:`ENTRY_COLUMNS`."""
        return self.parameter, self.quantity, self.unit, self.low, self.median, self.high


def stored_ledger(result: StoredResult) -> tuple[tuple[StoredEntry, ...], ...]:
    """A row a parameter that acts along the path, in it one entry a quantity of the path; display units."""
    stats = result.sample_stats
    if "ledger_weight" not in stats:
        return ()
    ending = "_quantiles"
    quantities = [str(v).removesuffix(ending) for v in stats.data_vars if str(v).endswith(ending)]

    def entry(i: int, parameter: str, quantity: str) -> StoredEntry:
        v = stats[quantity + ending]
        shown = v.attrs["display_units"]
        numbers = convert(np.asarray(v.values[i], dtype=float), v.attrs["units"], shown).tolist()
        symbol = result.posterior[parameter].attrs["symbol"]
        return StoredEntry(
            parameter, symbol, quantity.removeprefix("ledger_"), v.attrs["long_name"], shown, *numbers
        )

    names = list(map(str, stats["path_parameter"].values))
    return tuple(tuple(entry(i, name, q) for q in quantities) for i, name in enumerate(names))


def _in_order(a: Analysis) -> list[Any]:
    """As the model offers them, so that the files of a campaign agree."""
    names = [one.name for one in a.problem.model.alternatives]
    return sorted(a.what_if, key=lambda shift: names.index(shift.name))


def _text(strings: Iterable[str]) -> np.ndarray[Any, Any]:
    return np.array(list(strings), dtype=object)
