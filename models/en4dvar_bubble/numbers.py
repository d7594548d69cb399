"""Numbers of a bubble that are known unless told otherwise; ``parameters:`` may name them, to fix or to estimate them.

Constants of the medium and the gas, amplitude, time and shape of the driving, and the state at time zero.
"""

from collections.abc import Mapping
from dataclasses import Field
from types import MappingProxyType
from typing import Any

import numpy as np

from en4dvar.model.state import Parameter
from en4dvar_bubble.driving.base import KNOTS
from en4dvar_bubble.driving.pulses import PULSES, numbers_of
from en4dvar_bubble.driving.tabulated import OF_RECORD
from en4dvar_bubble.medium import CONSTANTS

_KNOWN = ("M_g",)  # no path depends on it: the mass fraction of vapour is only told
_NAMES = {"S": "surface_tension"}  # the state has a field S, the stress integral
_LABELS = {
    "D_p": "exponent of the pressure in the diffusivity",
    "D_T": "exponent of the temperature in the diffusivity",
}
_SYMBOLS = {"rho": r"\rho", "p_inf": r"p_\infty", "surface_tension": "S", "kappa": r"\kappa"}
_SYMBOLS |= {"tait_B": r"B_\mathrm{Tait}", "tait_n": r"n_\mathrm{Tait}"}


def _of(constant: Field[Any]) -> Parameter:
    about, name = constant.metadata, _NAMES.get(constant.name, constant.name)
    words = about["description"].partition(" (")[0].rstrip(".")
    label = words if words.startswith("Tait") else _LABELS.get(name, words[0].lower() + words[1:])
    bounds = about["bounds"]
    least, most = bounds.get("gt", bounds.get("ge", 0.0)), bounds.get("le", np.inf)
    shown = "kPa" if about["unit"] == "Pa" else ""
    symbol = f"${_SYMBOLS.get(name, name)}$"
    return Parameter(name, about["unit"], "lognormal", (least, most), label, symbol, shown, about["source"], True)


_VAPOUR = "constant vapour pressure in the bubble"
OF_MEDIUM: Mapping[str, Parameter] = MappingProxyType(
    {constant.name: _of(constant) for constant in CONSTANTS if constant.name not in _KNOWN}
    | {"p_v": Parameter("p_v", "Pa", "lognormal", (0.0, np.inf), _VAPOUR, "$p_v$", "kPa", common=True)}
)
"""Constant of the medium → the parameter that sets it."""
P_A = Parameter("p_A", "Pa", "normal", label="amplitude of the driving", symbol="$p_A$", display_unit="MPa")
GAS_CONTENT = Parameter(
    "gas_content",
    "1",
    "lognormal",
    (0.0, np.inf),
    "amount of gas over that in equilibrium at the stress-free radius",
    r"$n_g/n_\mathrm{eq}$",
)
R_START = Parameter("R_start", "m", "lognormal", (0.0, np.inf), "radius at time zero", "$R(0)$", "um")
RDOT_START = Parameter("Rdot_start", "m/s", "normal", label="velocity of the wall at time zero", symbol=r"$\dot{R}(0)$")
WALL_DISTANCE = Parameter(
    "wall_distance",
    "m",
    "lognormal",
    (0.0, np.inf),
    "distance of the wall from the centre of the bubble",
    "$h$",
    "um",
    "Rattray (1951), PhD thesis, California Institute of Technology",
)
ACCOMMODATION = Parameter(
    "accommodation",
    "1",
    "lognormal",
    (0.0, np.inf),
    "part of the vapour's molecules at the wall that condense",
    r"$\alpha_M$",
    "",
    "Hertz–Knudsen; water, measured 0.01 to 1: Marek & Straub (2001), Int. J. Heat Mass Transf. 44, 39",
    True,
)
"""Where it is no parameter, the vapour at the wall is saturated: the limit of a large one."""
_OF_PULSES = {p.name: p for made in PULSES.values() for _, _, p in numbers_of(made)}
_OF_PULSES |= {number.parameter.name: number.parameter for number in OF_RECORD} | {p.name: p for p in KNOTS}
ALL = (*OF_MEDIUM.values(), P_A, GAS_CONTENT, R_START, RDOT_START, WALL_DISTANCE, ACCOMMODATION, *_OF_PULSES.values())
NAMES = frozenset(p.name for p in ALL)
