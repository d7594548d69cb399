"""The minima of J that count, and where all descents ended, in a result file."""

from __future__ import annotations

from typing import Any

import numpy as np

from en4dvar.analysis import Analysis, Descents
from en4dvar.storage.netcdf import Variable, variable


def mode_variables(a: Analysis) -> dict[str, Variable]:
    """Variables of ``sample_stats``, the lowest minimum first; none of a scheme that does not search."""
    if not a.modes or a.descents is None:
        return {}
    centres = np.stack([mode.centre for mode in a.modes])
    where = "minimum of J, each in the unit of its parameter"
    return {
        "mode_centre": variable(("mode", "parameter"), centres, "1", where),
        "mode_cost": variable("mode", [mode.cost for mode in a.modes], "1", "J at the minimum"),
        "mode_weight": variable("mode", [mode.weight for mode in a.modes], "1", "probability of the mode"),
        "mode_descents": variable("mode", [mode.descents for mode in a.modes], "1", "descents that ended there"),
        "mode_cost_spread": variable("mode", [mode.spread for mode in a.modes], "1", "by how much J of these differs"),
        **_descents(a.descents),
    }


def _descents(d: Descents) -> dict[str, Variable]:
    costs = [d.costs[number] if number >= 0 else np.nan for number in d.minimum]
    member = "member of the prior ensemble from which it started, -1: the mean, -2: a draw beyond it"
    minimum = "number of the minimum of J in which it ended, 0: the lowest, -1: none"
    return {
        "descent_member": variable("descent", np.array(d.members), "1", member, fill=False),
        "descent_minimum": variable("descent", np.array(d.minimum), "1", minimum, fill=False),
        "descent_cost": variable("descent", costs, "1", "J at that minimum"),
    }


def descent_scalars(a: Analysis) -> dict[str, Any]:
    """Attributes of ``sample_stats``; none of a scheme that does not search."""
    if a.descents is None:
        return {}
    return {
        "n_descents": len(a.descents.members),
        "n_agreeing": a.descents.agreeing,
        "cost_spread": a.descents.spread,
        "search_runs": a.descents.runs,
        "descents": a.descents.words,
    }
