"""The group ``fields`` of a result file: fields of the initial state that were estimated cell by cell.

Of a field ``ln_T``: ``ln_T`` (draw, ln_T_cell), the posterior members in single precision, since there may be many;
``ln_T_mean``, ``_std``, ``_centre``, ``_prior_mean`` and ``_prior_std`` (ln_T_cell), and the coordinates of the cells
``ln_T_at`` (ln_T_cell, ln_T_axis).
"""

from __future__ import annotations

from typing import Any

from en4dvar.analysis import Analysis, FieldEstimate
from en4dvar.state import Array
from en4dvar.storage.netcdf import Group, Variable, variable

KINDS = {
    "mean": "posterior mean",
    "std": "posterior standard deviation",
    "centre": "value at the minimum of J",
    "prior_mean": "prior mean",
    "prior_std": "prior standard deviation",
}


def field_groups(a: Analysis) -> dict[str, Group]:
    """The group, where there are fields."""
    variables = {name: one for field in a.fields for name, one in _variables(field).items()}
    return {"/fields": Group(variables)} if variables else {}


def _variables(found: FieldEstimate) -> dict[str, Variable]:
    field, name, cells = found.prior.field, found.prior.field.name, f"{found.prior.field.name}_cell"
    about: dict[str, Any] = {"display_units": field.display_unit, "symbol": field.symbol}

    def of_cells(values: Array, what: str) -> Variable:
        return variable(cells, values, field.unit, f"{field.label}, {what}", **about)

    posterior = f"{field.label}, posterior members"
    return {
        name: variable(("draw", cells), found.members, field.unit, posterior, single=True, **about),
        **{f"{name}_{kind}": of_cells(getattr(found, kind), words) for kind, words in KINDS.items()},
        f"{name}_at": variable(
            (cells, f"{name}_axis"), found.prior.places, field.coordinate_unit, "where the cells are"
        ),
    }
