"""Which gas a first configuration proposes, and what is quicker to compare with."""

from collections.abc import Mapping

from en4dvar_bubble.medium import WATER_25C
from en4dvar_bubble.starter.look import Look, Start

MODEL: Mapping[Start, Mapping[str, str]] = {
    "acoustic": {"gas": "heat"},
    "laser": {"gas": "heat", "vapour": "transport", "medium_heat": "conducting", "gas_change": "0.7"},
}
WHY = {
    "heat": "the gas gives heat to the wall",
    "transport": "near R_max there is more vapour than gas; it condenses at the wall, through the gas",
    "none": "but for its pressure: no grid holds the gas that vapour leaves at the wall of a bubble so large or fast",
    "saturated": "that of water at the temperature of the medium",
    "16": "in the gas: a bubble so large or fast has a thin layer at its wall (docs/solver.md)",
    "0.7": "std of ln of what collapses multiply the gas by, for what is expected after the window (docs/physics.md)",
    "viscosity_change": "std of ln of its change after the window: viscosity is not all that damps the first collapses",
    "rtol": "of a coating that buckles J is smoother then, and the search for its minimum converges",
    "conducting": "the wall warms; with a cold one R_eq comes out wrong (docs/calibration.md)",
}
# The quicker gas that a laser-induced bubble can be compared with; benchmarks/laser_gas.py has what it costs.
SIMPLER: Mapping[Start, Mapping[str, str]] = {
    "acoustic": {},
    "laser": {"gas": "polytropic", "vapour": "none", "medium_heat": "cold", "vapour_pressure": "saturated"},
}
# Of R_max²/(D t_c), D the diffusivity of vapour: below the first, 12 nodes err by up to 1 % of R_max, below the second
# 16 do; beyond it paths depend on the number of nodes, whatever it is (docs/solver.md).
FINE, UNRESOLVED = 300.0, 600.0


def physics(start: Start, look: Look | None = None) -> Mapping[str, str]:
    """Keys of the model and their values: of :data:`MODEL`, what a grid holds of it in a bubble as large as that of the
    ``look``.
    """
    usual = MODEL[start]
    if look is None or usual.get("vapour") != "transport":
        return usual
    layer = look.lobe.R_max**2 / (WATER_25C.D_v * look.lobe.t_c)
    if layer < FINE:
        return usual
    if layer < UNRESOLVED:
        return {**usual, "nodes": "16"}
    return {**usual, "vapour": "none", "vapour_pressure": "saturated"}
