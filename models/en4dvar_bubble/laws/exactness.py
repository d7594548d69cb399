"""Whether the table of a law is the law: what cannot be tabulated is refused, by name."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any, TypeVar, cast

import numpy as np

from en4dvar_bubble.laws.parameters import columns
from en4dvar_bubble.laws.refined import ERROR, HALVINGS
from en4dvar_bubble.laws.tabulate import GRID, differentiate, from_function, from_strain_energy
from en4dvar_bubble.tables import evaluate

TABLE_ERROR = 1e-6
"""Largest relative error of dJ/dλ in a uniform table; that of J is a hundredth of it."""
_PACKAGE = f"{__package__}."
F = TypeVar("F", bound=Callable[..., Any])
_POINTS_IN_CELL = 8
_STENCIL = np.array([1 / 280, -4 / 105, 1 / 5, -4 / 5, 0, 4 / 5, -1 / 5, 4 / 105, -1 / 280])
_STEP = 5e-3


def slope_error(law: Any) -> tuple[float, float]:
    """Largest relative error of dJ/dλ in a uniform table at the example values, and the stretch where it is; NaN where
    the law has no value inside its range.
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
    with np.errstate(all="ignore"):  # a law may overflow at stretches that no member reaches
        uniform = (
            from_function(lambda at: law.stress(at, p), 1)
            if law.closed_form
            else from_strain_energy(lambda at: law.strain_energy_rate(at, p), 1)
        )
    table = evaluate(differentiate(uniform), GRID.span, np.log(stretch)[None])[0] / stretch
    scale = np.abs(exact) + 1e-6 * np.max(np.abs(exact * stretch)) / stretch
    error = np.where(scale > 0, np.abs(table - exact) / np.where(scale > 0, scale, 1), np.abs(table))
    worst = int(np.argmax(error))
    return float(error[worst]), float(stretch[worst])


def _once(function: F) -> F:
    """:func:`functools.cache` for functions of a class, which mypy takes for unhashable."""
    return cast(F, cache(function))


@_once
def is_sharp(kind: type[Any]) -> bool:
    """Whether a law of a user's has a uniform table that is wrong; tests hold those of the package to be right."""
    if kind.__module__.startswith(_PACKAGE):
        return False
    try:
        with np.errstate(all="ignore"):
            return slope_error(kind())[0] >= TABLE_ERROR
    except Exception:  # what is wrong with the methods is told by those who call them
        return False


@_once
def refuse_inexact(kind: type[Any]) -> None:
    """Raise ValueError for a sharp law whose stress jumps, or is too rough for cells however narrow."""
    if not is_sharp(kind):
        return
    law = kind()
    lowest, highest = law.stretch_range
    inexact = np.exp(law.refined(law.example_values()).x)
    inexact = inexact[(inexact > lowest) & (inexact < highest)]
    if len(inexact):
        raise ValueError(
            f"{law.name}: its stress changes too sharply for the table that the solver reads: at λ = {inexact[0]:.6g} "
            f"it jumps, or is too rough for cells of {GRID.step * 0.5**HALVINGS:.0e} in ln λ to hold it to {ERROR:g} "
            "of its size. Make it continuous there (a kink does no harm), or narrow stretch_range to where it is "
            "continuous, if bubbles stay inside (en4dvar laws --check says more)"
        )
