"""The ``data.error:`` section in the model's units: std, timing, correlation or a whole covariance, a robust cost."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from en4dvar.config import schema
from en4dvar.config.document import Document
from en4dvar.config.validate import check
from en4dvar.errors import Fault
from en4dvar.forward import ForwardModel, Observable
from en4dvar.hints import suggest
from en4dvar.inputs.readers import Matrix
from en4dvar.units import UnitError, convert, parse_quantity

_RELATIVE = re.compile(r"(.*%)\s+of\s+(?:the\s+)?maximum")
HUBER = 1.345  # 95 % efficiency where the errors are Gaussian after all: Huber (1981), Robust Statistics


@dataclass(frozen=True)
class Spread:
    """An observation-error std: ``value`` in the observable's unit, or a fraction of the observed maximum."""

    value: float
    relative: bool = False

    def absolute(self, maximum: float) -> float:
        return self.value * abs(maximum) if self.relative else self.value


@dataclass(frozen=True)
class ErrorPlan:
    """R before the data are read: ``std`` or a ``covariance`` file, ``time_std``, ``correlation_time``, ``huber``."""

    std: Spread | None
    time_std: float = 0.0
    correlation_time: float | None = None
    covariance: Matrix | None = None
    huber: float | None = None


def parse_spread(text: str | float, unit: str) -> Spread:
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


def read_error(
    raw: Mapping[str, Any], base: Path, observable: Observable, model: ForwardModel, document: Document,
    faults: list[Fault],
) -> ErrorPlan | None:  # fmt: skip
    """The plan, or None with every fault appended."""
    before = len(faults)
    key = f"{observable.name}_std"
    known = [key, "time_std", "correlation_time", "covariance", "robust", "threshold"]

    def fault(name: str, message: str, at_key: bool = False) -> None:
        faults.append(document.fault(("data", "error", name), message, at_key=at_key))

    def number(name: str, parse: Callable[[Any], float], allow_zero: bool = False) -> float | None:
        if name not in raw:
            return None
        try:
            value = parse(raw[name])
        except UnitError as error:
            fault(name, str(error))
            return None
        if value < 0 or (value == 0 and not allow_zero):
            fault(name, f"must {'not be negative' if allow_zero else 'be positive'}, not {raw[name]}")
        return value

    def exclude(name: str, other: str, reason: str) -> None:
        if name in raw and other in raw:
            fault(name, f"not together with {other}: {reason}", at_key=True)

    for name in raw:
        if name not in known:
            fault(name, f"unknown key {name!r}{suggest(name, known)}", at_key=True)
    unit = model.time_unit
    time_std = number("time_std", lambda value: parse_quantity(value, unit), allow_zero=True)
    correlation_time = number("correlation_time", lambda value: parse_quantity(value, unit))
    threshold = number("threshold", lambda value: parse_quantity(value, "1"))
    if raw.get("robust", "huber") != "huber":
        fault("robust", f"{raw['robust']!r} is not huber")
    if "threshold" in raw and "robust" not in raw:
        fault("threshold", "is that of the robust cost; write robust: huber as well", at_key=True)
    exclude("covariance", key, "the file holds the variances")
    exclude("covariance", "correlation_time", "the file holds the correlations")
    for name in ("correlation_time", "covariance"):
        exclude("robust", name, "a robust cost needs independent observation errors")
    covariance = _covariance(raw["covariance"], base, observable, document, faults) if "covariance" in raw else None
    std = None if "covariance" in raw else _std(raw, key, observable, document, faults)
    if len(faults) > before:
        return None
    huber = (HUBER if threshold is None else threshold) if "robust" in raw else None
    return ErrorPlan(std, time_std or 0.0, correlation_time, covariance, huber)


def _std(
    raw: Mapping[str, Any], key: str, observable: Observable, document: Document, faults: list[Fault]
) -> Spread | None:
    path = ("data", "error", key)
    if key not in raw:
        faults.append(document.fault(path, "required: the standard deviation of the observation error"))
        return None
    try:
        spread = parse_spread(raw[key], observable.unit)
    except UnitError as error:
        faults.append(document.fault(path, str(error)))
        return None
    if not spread.value > 0:
        faults.append(document.fault(path, f"must be positive, not {raw[key]}"))
        return None
    return spread


def _covariance(raw: Any, base: Path, observable: Observable, document: Document, faults: list[Fault]) -> Matrix | None:
    path = ("data", "error", "covariance")
    file = check(schema.CovarianceFile, raw, path, document, faults)
    if file is None:
        return None
    target = "1" if observable.unit == "1" else f"({observable.unit})*({observable.unit})"
    try:
        convert(1.0, file.unit, target)
    except UnitError as error:
        faults.append(document.fault((*path, "unit"), str(error)))
        return None
    return Matrix(base / Path(file.path).expanduser(), file.unit, target)
