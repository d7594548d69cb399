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
from en4dvar_bubble.driving.pulses import OF_RECORD, PULSES, numbers_of
from en4dvar_bubble.medium import CONSTANTS


def positive(
    name: str, unit: str, label: str, symbol: str, source: str = "", display_unit: str = "", least: float = 0.0,
    common: bool = False,
) -> Parameter:  # fmt: skip
    """A parameter that cannot be negative, lognormal by default."""
    return Parameter(name, unit, "lognormal", (least, np.inf), label, symbol, display_unit, source, common)


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


OF_MEDIUM: Mapping[str, Parameter] = MappingProxyType(
    {constant.name: _of(constant) for constant in CONSTANTS if constant.name not in _KNOWN}
    | {"p_v": positive("p_v", "Pa", "constant vapour pressure in the bubble", "$p_v$", "", "kPa", common=True)}
)
"""Constant of the medium → the parameter that sets it."""
P_A = Parameter(
    "p_A", "Pa", "normal", label="amplitude of the driving", symbol="$p_A$", display_unit="MPa", common=True
)
"""Common, for one transducer drives all bubbles of an experiment: an error of its hydrophone no number of them averages
out."""
_CONTENT = "amount of gas over that in equilibrium at the stress-free radius"
GAS_CONTENT = positive("gas_content", "1", _CONTENT, r"$n_g/n_\mathrm{eq}$")
R_START = positive("R_start", "m", "radius at time zero", "$R(0)$", "", "um")
RDOT_START = Parameter("Rdot_start", "m/s", "normal", label="velocity of the wall at time zero", symbol=r"$\dot{R}(0)$")
_RATTRAY = "Rattray (1951), PhD thesis, California Institute of Technology"
WALL_DISTANCE = positive(
    "wall_distance", "m", "distance of the wall from the centre of the bubble", "$h$", _RATTRAY, "um"
)
_MAREK = "Hertz–Knudsen; water, measured 0.01 to 1: Marek & Straub (2001), Int. J. Heat Mass Transf. 44, 39"
ACCOMMODATION = positive(
    "accommodation", "1", "part of the vapour's molecules at the wall that condense", r"$\alpha_M$", _MAREK, common=True
)
"""Where it is no parameter, the vapour at the wall is saturated: the limit of a large one."""
_OF_PULSES = {p.name: p for made in PULSES.values() for _, _, p in numbers_of(made)}
_OF_PULSES |= {number.parameter.name: number.parameter for number in OF_RECORD} | {p.name: p for p in KNOTS}
ALL = (*OF_MEDIUM.values(), P_A, GAS_CONTENT, R_START, RDOT_START, WALL_DISTANCE, ACCOMMODATION, *_OF_PULSES.values())
NAMES = frozenset(p.name for p in ALL)
