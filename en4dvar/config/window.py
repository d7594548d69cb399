"""``data.window`` and ``data.time_zero``: which observations are used, and where the model's clock starts."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field

from en4dvar.config.context import Context, Made, time_unit
from en4dvar.config.schema import Section
from en4dvar.inputs.window import Instant, parse_instant
from en4dvar.units import UnitError, parse_quantity


def _instant(text: Any, context: Context) -> Instant:
    possible = (context.observed,) if context.observed else context.units.observables
    symbols = {word for observable in possible for word in (observable.symbol.strip("$"), observable.name)}
    return parse_instant(text, time_unit(context), symbols)


def _prominence(text: Any, context: Context) -> float:
    value = parse_quantity(text, "1")
    if not 0 < value < 1:
        raise ValueError("must lie between 0 and 100 %")
    return value


class WindowSection(Section):
    """First and last observation used: ``maximum``, ``minimum 2``, a time, or ``start``/``end`` of the file."""

    start: Annotated[Instant, Made(_instant)] = Field("start", alias="from", validate_default=True)
    """First observation: start, maximum (for the bubble also R_max), minimum N, or a time on the file's clock."""
    end: Annotated[Instant, Made(_instant)] = Field("end", alias="to", validate_default=True)
    """Last observation: end, maximum, minimum N (counted from the window's start), or a time on the file's clock."""
    prominence: Annotated[float, Made(_prominence)] = Field("10 %", validate_default=True)
    """How deep a minimum must be to count, relative to the range of the series."""


def read_time_zero(text: Any, context: Context) -> Literal["file", "window"] | float:
    if text in ("file", "window"):
        return "file" if text == "file" else "window"
    try:
        return parse_quantity(text, time_unit(context))
    except UnitError as error:
        raise UnitError(f"write file, window or a time: {error}") from None
