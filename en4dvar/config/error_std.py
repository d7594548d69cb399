"""Standard deviations of observation errors as they are written: a quantity, a share, or a column of the file."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import Field

from en4dvar.config.context import TEXT, Context, Spread, observable_unit, require_sign, time_unit
from en4dvar.config.schema import Section
from en4dvar.inputs.asked import Column
from en4dvar.units import UnitError, convert, parse_quantity

_RELATIVE = re.compile(r"(.*%)\s+of\s+(?:the\s+)?maximum")


def parse_error_std(text: Any, unit: str) -> Spread:
    """``"1.4 um"`` or ``"1 % of maximum"``. Raises :class:`UnitError`."""
    word = str(text).strip()
    relative = _RELATIVE.fullmatch(word)
    if relative:
        return Spread(parse_quantity(relative[1], "1"), relative=True)
    try:
        return Spread(parse_quantity(text, unit))
    except UnitError as error:
        hint = f"; write '{word} of maximum'" if word.endswith("%") else ""
        raise UnitError(f"{error}{hint}") from None


class ErrorColumn(Section):
    """A column of standard deviations, one per reading."""

    column: Annotated[str, Field(min_length=1)]
    """Header of the column (CSV) or name of the field (.mat)."""
    unit: str | None = None
    """Unit of the numbers in it; default: that of the readings' own column."""


def error_column(given: Any, context: Context, target: str) -> Column:
    chosen = ErrorColumn.model_validate(given, context=context)
    if chosen.unit is not None:
        convert(1.0, chosen.unit, target)
    return Column(chosen.column, chosen.unit or "", target)


def read_error_std(text: Any, context: Context) -> Spread | Column:
    if isinstance(text, Mapping):
        return error_column(text, context, observable_unit(context))
    return read_spread(text, context)


def read_spread(text: Any, context: Context) -> Spread:
    spread = parse_error_std(text, observable_unit(context))
    require_sign(spread.value, "positive", text)
    return spread


def read_time_std(text: Any, context: Context) -> float | Column:
    if isinstance(text, Mapping):
        return error_column(text, context, time_unit(context))
    value = parse_quantity(text, time_unit(context))
    require_sign(value, "not negative", text)
    return value


QUANTITY_OR_COLUMN = {"anyOf": [TEXT, ErrorColumn.model_json_schema()]}
