"""Whether the table of a law is the law: what cannot be tabulated is refused, by name."""

from __future__ import annotations

from functools import cache

import numpy as np

from en4dvar_bubble.laws.base import REGISTRY, ConstitutiveLaw, columns
from en4dvar_bubble.laws.tabulate import GRID, differentiate
from en4dvar_bubble.tables import evaluate

TABLE_ERROR = 1e-6
"""Largest relative error of dJ/dλ; that of J is a hundredth of it."""
_POINTS_IN_CELL = 8
_STENCIL = np.array([1 / 280, -4 / 105, 1 / 5, -4 / 5, 0, 4 / 5, -1 / 5, 4 / 105, -1 / 280])
_STEP = 5e-3


def slope_error(law: ConstitutiveLaw) -> tuple[float, float]:
    """Largest relative error of dJ/dλ in the table at the example values, and the stretch where it is; NaN where the
    law has no value inside its range.
    """
    values = law.example_values()
    lowest, highest = np.log(law.stretch_range)
    x = np.arange(lowest, highest, GRID.step / _POINTS_IN_CELL)
    stretch = np.exp(x[np.abs(x) > 1e-3])
    p = columns(values)
    if law.closed_form:
        samples = [
            np.broadcast_to(law.stress(stretch * (1 + k * _STEP), p), (1, len(stretch)))[0] for k in range(-4, 5)
        ]
        exact = _STENCIL @ np.stack(samples) / (_STEP * stretch)
    else:
        exact = -np.broadcast_to(law.strain_energy_rate(stretch, p), (1, len(stretch)))[0] / (stretch**3 - 1)
    table = evaluate(differentiate(law.table(values)), GRID.span, np.log(stretch)[None])[0] / stretch
    scale = np.abs(exact) + 1e-6 * np.max(np.abs(exact * stretch)) / stretch
    error = np.where(scale > 0, np.abs(table - exact) / np.where(scale > 0, scale, 1), np.abs(table))
    worst = int(np.argmax(error))
    return float(error[worst]), float(stretch[worst])


@cache
def refuse_inexact(kind: type[ConstitutiveLaw]) -> None:
    """Raise ValueError for a law of a user's whose table would be wrong; tests hold those of the package to it."""
    if kind in REGISTRY.values():
        return
    try:
        law = kind()
        with np.errstate(all="ignore"):
            error, stretch = slope_error(law)
    except Exception:  # what is wrong with the methods is told by those who call them
        return
    if error >= TABLE_ERROR:
        raise ValueError(
            f"{law.name}: its stress changes too sharply for the table that the solver reads: at λ = {stretch:.4g} "
            f"dJ/dλ is wrong by {error:.1g} of its value, and the path would be. Nodes are {GRID.step:g} apart in "
            "ln λ: smooth the law on that scale, or narrow stretch_range to where it is smooth, if bubbles stay inside "
            "(en4dvar laws --check says more)"
        )
