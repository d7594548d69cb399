"""Parameters that vary in time, in a result file: the values of their pieces beside the parameters of the ensemble."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from en4dvar.analysis import Analysis
from en4dvar.state import Array
from en4dvar.storage.netcdf import Variable, variable

PIECES, PIECE = "_pieces", "_piece"  # end the names of the values and of their dimension


def pieces(a: Analysis, members: Array) -> dict[str, Variable]:
    """Values (chain, draw, piece) over the pieces of each parameter that varies, of ``members`` (N, n)."""

    def about(walk: Any) -> dict[str, Any]:
        p = walk.parameter
        return {
            "units": p.unit,
            "long_name": f"{p.label}, over the pieces of time",
            "display_units": p.display_unit,
            "symbol": p.symbol,
        }

    return {
        walk.pieces_name: variable(("chain", "draw", walk.name + PIECE), a.pieces(walk, members)[None], **about(walk))
        for walk in a.problem.walks
    }


def piece_coordinates(a: Analysis) -> dict[str, Variable]:
    """The instants, on the model's clock, at which the pieces begin."""
    model = a.problem.model
    about: Mapping[str, Any] = {"display_units": model.time_display_unit, "symbol": "t", "axis": "T"}
    return {
        walk.name + PIECE: variable(
            walk.name + PIECE, (0.0, *walk.knots), model.time_unit, "begin of the piece", fill=False, **about
        )
        for walk in a.problem.walks
    }


def change_scalars(a: Analysis) -> dict[str, Any]:
    """The evidence against constant parameters."""
    if a.log_evidence_constant is None or a.log_evidence_change is None:
        return {}
    return {
        "varying": " and ".join(one.label for one in a.problem.varying),
        "log_evidence_constant": a.log_evidence_constant,
        "log_evidence_change": a.log_evidence_change,
    }
