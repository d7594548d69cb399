"""The minima of J that count, in a result file."""

from __future__ import annotations

import numpy as np

from en4dvar.analysis import Analysis
from en4dvar.storage.netcdf import Variable, variable


def mode_variables(a: Analysis) -> dict[str, Variable]:
    """Variables of ``sample_stats``, the lowest minimum first; none of a scheme that does not search."""
    if not a.modes:
        return {}
    centres = np.stack([mode.centre for mode in a.modes])
    where = "minimum of J, each in the unit of its parameter"
    return {
        "mode_centre": variable(("mode", "parameter"), centres, "1", where),
        "mode_cost": variable("mode", [mode.cost for mode in a.modes], "1", "J at the minimum"),
        "mode_weight": variable("mode", [mode.weight for mode in a.modes], "1", "probability of the mode"),
        "mode_descents": variable("mode", [mode.descents for mode in a.modes], "1", "descents that ended there"),
        "mode_cost_spread": variable("mode", [mode.spread for mode in a.modes], "1", "by how much J of these differs"),
    }
