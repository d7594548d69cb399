"""Whether the table of a law is the law: what cannot be tabulated is refused, by name."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any, TypeVar, cast

import numpy as np

from en4dvar_bubble.laws.parameters import columns
from en4dvar_bubble.laws.refined import ERROR, HALVINGS
from en4dvar_bubble.laws.tabulate import GRID, Function, differentiate, from_function, from_strain_energy
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
    """Whether a law has a uniform table that is wrong; those of the package say so, and tests hold them to it."""
    if kind.__module__.startswith(_PACKAGE):
        return bool(kind.kinked)
    try:
        with np.errstate(all="ignore"):
            return slope_error(kind())[0] >= TABLE_ERROR
    except Exception:  # what is wrong with the methods is told by those who call them
        return False


@_once
def refuse_inexact(kind: type[Any]) -> None:
    """Raise ValueError for a sharp law whose stress jumps, or is too rough for cells however narrow, and for one whose
    other functions of the stretch, for which no cells are halved, a uniform table does not hold.
    """
    law = kind()
    if law.strain_dependent or law.memory_count:
        _refuse_rough(law)
    if not is_sharp(kind):
        return
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


def _refuse_rough(law: Any) -> None:
    """Raise ValueError for a viscosity or a memory function of the stretch that a table does not hold to 1e-6 of the
    larger of its size there and its largest between λ = 1/2 and 2.
    """
    p, (lowest, highest) = columns(law.example_values()), np.log(law.stretch_range)
    x = np.arange(lowest, highest, GRID.step / _POINTS_IN_CELL)
    functions: dict[str, Function] = {}
    if law.strain_dependent:
        functions["its strained_viscosity"] = lambda stretch: law.strained_viscosity(stretch, p)
    for i, variable in enumerate(law.memory(p)):
        functions[f"the stiffness of its memory variable {i + 1}"] = variable.stiffness_at
        functions[f"the equilibrium of its memory variable {i + 1}"] = variable.equilibrium_at
    for what, function in functions.items():
        with np.errstate(all="ignore"):
            exact = np.broadcast_to(function(np.exp(x)), (1, len(x)))[0]
            error = np.abs(evaluate(from_function(function, 1), GRID.span, x[None])[0] - exact)
            allowed = TABLE_ERROR * np.maximum(np.abs(exact), np.max(np.abs(exact[np.abs(x) < np.log(2)]), initial=0.0))
        if np.any(error > allowed):
            where = np.exp(x[np.argmax(error - allowed)])
            raise ValueError(
                f"{law.name}: {what} changes too sharply near λ = {where:.3g} for the table that the solver reads, "
                f"whose cells are {GRID.step:g} wide in ln λ: make it smoother there, or narrow stretch_range to where "
                "it is smooth, if bubbles stay inside"
            )
