"""The ``data:`` section in the model's units: which columns, which window, which errors."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar

from en4dvar.config import schema
from en4dvar.config.document import Document
from en4dvar.config.observation_error import ErrorPlan, Spread, parse_spread, read_error
from en4dvar.config.validate import check
from en4dvar.errors import Fault
from en4dvar.forward import ForwardModel, Observable
from en4dvar.hints import suggest
from en4dvar.inputs.readers import Column, Format, Step
from en4dvar.inputs.text_table import Decimal
from en4dvar.inputs.window import Instant, parse_instant
from en4dvar.units import UnitError, convert, parse_quantity

__all__ = ["DataPlan", "Spread", "parse_spread", "read_data"]

T = TypeVar("T")


@dataclass(frozen=True)
class DataPlan:
    """How observations are read: everything but the files' content, in the model's units."""

    base: Path
    paths: tuple[str, ...]
    format: Format | None
    decimal: Decimal
    observable: Observable
    time: Column | Step
    value: Column
    start: Instant
    end: Instant
    prominence: float
    time_zero: Literal["file", "window"] | float
    error: ErrorPlan


def read_data(
    raw: schema.Data, base: Path, model: ForwardModel, document: Document, faults: list[Fault]
) -> DataPlan | None:
    """The plan, or None with every fault appended."""
    before = len(faults)

    def attempt(path: tuple[str, ...], parse: Callable[[], T]) -> T | None:
        try:
            return parse()
        except UnitError as error:
            faults.append(document.fault(("data", *path), str(error)))
            return None

    unit = model.time_unit
    observable = _observable(raw.columns, model, document, faults)
    time = _time(raw.columns.get("time"), unit, document, faults)
    value = _value(raw.columns, observable, document, faults) if observable else None
    symbols = (observable.symbol.strip("$"), observable.name) if observable else ()
    start = attempt(("window", "from"), lambda: parse_instant(raw.window.start, unit, symbols))
    end = attempt(("window", "to"), lambda: parse_instant(raw.window.end, unit, symbols))
    prominence = attempt(("window", "prominence"), lambda: parse_quantity(raw.window.prominence, "1"))
    zero = attempt(("time_zero",), lambda: _time_zero(raw.time_zero, unit))
    error = read_error(raw.error, base, observable, model, document, faults) if observable else None
    if prominence is not None and not 0 < prominence < 1:
        faults.append(document.fault(("data", "window", "prominence"), "must lie between 0 and 100 %"))
    if len(faults) > before or observable is None or time is None or value is None or error is None:
        return None
    if start is None or end is None or prominence is None or zero is None:
        return None
    paths = (raw.path,) if isinstance(raw.path, str) else raw.path
    return DataPlan(base, paths, raw.format, raw.decimal, observable, time, value, start, end, prominence, zero, error)


def _observable(
    columns: Mapping[str, Any], model: ForwardModel, document: Document, faults: list[Fault]
) -> Observable | None:
    known = {o.name: o for o in model.observables}
    for name in columns:
        if name != "time" and name not in known:
            message = f"unknown column role {name!r}{suggest(name, ['time', *known])}"
            faults.append(document.fault(("data", "columns", name), message, at_key=True))
            return None
    chosen = [name for name in columns if name in known]
    if len(chosen) != 1:
        faults.append(document.fault(("data", "columns"), f"name the column of one observable of: {', '.join(known)}"))
        return None
    return known[chosen[0]]


def _time(raw: Any, unit: str, document: Document, faults: list[Fault]) -> Column | Step | None:
    path = ("data", "columns", "time")
    if raw is None:
        faults.append(document.fault(path, f"required: {{name: <column>, unit: {unit}}}, or {{step: <quantity>}}"))
        return None
    column = check(schema.TimeColumn, raw, path, document, faults)
    if column is None:
        return None
    try:
        if column.unit is not None:
            convert(1.0, column.unit, unit)
            named = Column(str(column.name or column.step), column.unit, unit)
            return named if column.name else Step(named)
        return Step(value=parse_quantity(column.step or 0, unit))
    except UnitError as error:
        faults.append(document.fault((*path, "unit" if column.unit else "step"), str(error)))
        return None


def _value(raw: Mapping[str, Any], observable: Observable, document: Document, faults: list[Fault]) -> Column | None:
    path = ("data", "columns", observable.name)
    column = check(schema.Column, raw[observable.name], path, document, faults)
    if column is None:
        return None
    try:
        convert(1.0, column.unit, observable.unit)
    except UnitError as error:
        faults.append(document.fault((*path, "unit"), str(error)))
        return None
    return Column(column.name, column.unit, observable.unit)


def _time_zero(value: str | float, unit: str) -> Literal["file", "window"] | float:
    if value == "file":
        return "file"
    if value == "window":
        return "window"
    try:
        return parse_quantity(value, unit)
    except UnitError as error:
        raise UnitError(f"write file, window or a time: {error}") from None
