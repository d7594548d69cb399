"""Every kind of equations of the solver, integrated once for a microsecond."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from en4dvar_bubble.laws import get_law
from en4dvar_bubble.model import BubbleModel
from en4dvar_bubble.solver.driver import UNROLLED, preset

OTHER = max(UNROLLED) + 1  # a number of nodes whose loops are not unrolled


def examples() -> dict[str, Callable[[], object]]:
    """What is compiled, in words, and a call that does; for ``en4dvar warm-up``."""
    standard = preset("standard", "acoustic")
    heat = {m: BubbleModel(accuracy=replace(standard, nodes=m)) for m in (*filter(None, UNROLLED), OTHER)}
    models = {"polytropic or isothermal gas": BubbleModel(gas="polytropic")}
    models |= {f"heat, {m} nodes": model for m, model in heat.items() if m != OTHER}
    models |= {"heat, another number of nodes": heat[OTHER]}
    models |= {"general equations (vapour, conducting medium, memory, Gilmore)": BubbleModel(get_law("zener-neo-hookean"), radial="gilmore")}
    fung = BubbleModel(get_law("fung-kelvin-voigt"), "polytropic")
    calls: dict[str, Callable[[], object]] = {
        f"bubble, {what}": partial(_integrate, model) for what, model in models.items()
    }
    return calls | {"bubble, laws given as a strain energy": partial(_integrate, fung)}


def _integrate(model: BubbleModel) -> None:
    values = {**model.law.example_values(), "R0": np.ones(1) * 1e-6}
    model.trajectories(model.initial_states(values), np.array([1e-7, 1e-6]))
