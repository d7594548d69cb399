"""Uniform grids of instants."""

from typing import Annotated

import numpy as np
from pydantic import Field

from en4dvar.config.context import Context, time_unit
from en4dvar.config.schema import QuantityText, Section
from en4dvar.model.state import Array
from en4dvar.plumbing.units import UnitError, parse_quantity


def time_grid(start: str | float, end: str | float, step: str | float, unit: str) -> Array:
    """Instants (K,) from ``start`` to ``end``, both included. Raises :class:`UnitError`."""
    first = 0.0 if start == "start" else parse_quantity(start, unit)
    last, width = parse_quantity(end, unit), parse_quantity(step, unit)
    if not width > 0 or not last > first:
        raise UnitError(f"no instants from {first:g} to {last:g} {unit} in steps of {width:g} {unit}")
    steps = (last - first) / width * (1 + 1e-9)
    if not 2 <= steps < 1_000_000:
        raise UnitError(f"{steps:.6g} steps; give between 2 and a million")
    return np.asarray(first + width * np.arange(int(np.floor(steps)) + 1), dtype=float)


class Times(Section):
    """A uniform grid of instants, both ends included."""

    start: Annotated[QuantityText, Field(alias="from")] = "start"
    """First instant with its unit; start is time zero."""
    end: Annotated[QuantityText, Field(alias="to")]
    """Last instant with its unit."""
    step: QuantityText
    """Time step with its unit."""


def read_times(times: Times, context: Context) -> Array:
    """The instants (K,) of a grid."""
    return time_grid(times.start, times.end, times.step, time_unit(context))
