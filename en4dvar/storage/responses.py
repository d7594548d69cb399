"""How a posterior responds, in a result file: shifts under alternatives, and the ledger."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from en4dvar.analysis import Analysis
from en4dvar.response.ledger import QUANTILES
from en4dvar.storage.netcdf import Variable, variable

ALTERNATIVE = ("alternative", "parameter")


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
    times: dict[str, Any] = {"display_units": model.time_display_unit}
    found = {
        "ledger_time": variable(
            ("path_cell", "path_edge"), edges, model.time_unit, "begin and end of the cell", **times
        ),
        "ledger_weight": variable(of_cell, book.weights, "1", "share of the cell in what informed the parameter"),
        "ledger_kernel": variable(of_cell, book.kernel, "1", "averaging kernel of the estimate over the cell"),
    }
    for i, q in enumerate(book.quantities):
        about: dict[str, Any] = {"display_units": q.display_unit, "symbol": q.symbol}
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


def _in_order(a: Analysis) -> list[Any]:
    """As the model offers them, so that the files of a campaign agree."""
    names = [one.name for one in a.problem.model.alternatives]
    return sorted(a.what_if, key=lambda shift: names.index(shift.name))


def _text(strings: Iterable[str]) -> np.ndarray[Any, Any]:
    return np.array(list(strings), dtype=object)
