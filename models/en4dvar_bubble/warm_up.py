"""Every kind of equations of the solver, integrated once for a microsecond."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from en4dvar_bubble.laws import get_law
from en4dvar_bubble.model import BubbleModel
from en4dvar_bubble.solver.driver import UNROLLED, preset

OTHER = max(UNROLLED) + 1  # a number of nodes whose loops are not unrolled


def examples() -> dict[str, Callable[[], object]]:
    """Name of each kernel, in words, and a call that compiles it; for ``en4dvar warm-up``."""
    standard = preset("standard", "acoustic")
    models = {"polytropic or isothermal gas": BubbleModel(gas="polytropic")}
    for nodes, words in ((4, "4 nodes"), (8, "8 nodes"), (OTHER, "another number of nodes")):
        models[f"heat, {words}"] = BubbleModel(accuracy=replace(standard, nodes=nodes))
    zener, fung = get_law("zener-neo-hookean"), get_law("fung-kelvin-voigt")
    models["general equations (vapour, conducting medium, memory, Gilmore)"] = BubbleModel(zener, radial="gilmore")
    models["tables of laws"] = BubbleModel(fung, "polytropic", start="laser")
    return {f"bubble, {what}": partial(_integrate, model) for what, model in models.items()}


def _integrate(model: BubbleModel) -> None:
    radii = {"R0": np.full(1, 1e-6), "R_eq": np.full(1, 4e-5), "R_max": np.full(1, 2e-4)}
    values = {**model.law.example_values(), **radii}
    model.trajectories(model.initial_states(values), np.array([1e-7, 1e-6]))
