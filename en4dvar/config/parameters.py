"""The ``parameters:`` section: what is estimated, what is fixed, and what waits for a number from the data file."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

from en4dvar.config import schema
from en4dvar.config.document import Document
from en4dvar.config.validate import check
from en4dvar.errors import ConfigError, Fault
from en4dvar.forward import ForwardModel
from en4dvar.hints import suggest
from en4dvar.prior import PriorTerm
from en4dvar.state import NOISE_SCALE, TIME_SHIFT, Parameter
from en4dvar.units import UnitError, convert, parse_quantity

_PERCENT = re.compile(r"([^%]*)%")
_RECIPES = {
    "normal": "mean and std",
    "lognormal": "median and log_std, or mean and std",
    "logit": "lower, upper, median and logit_std",
}


@dataclass(frozen=True)
class Fixed:
    """A parameter held at ``value`` (its own unit)."""

    needs_data: ClassVar[bool] = False
    parameter: Parameter
    value: float


@dataclass(frozen=True)
class Scalar:
    """A parameter held at a scalar of the data file."""

    needs_data: ClassVar[bool] = True
    parameter: Parameter
    name: str
    unit: str

    def value(self, scalars: Mapping[str, float], source: str) -> float:
        """The value in the parameter's unit. Raises :class:`ConfigError` when the file does not hold it."""
        if self.name not in scalars:
            raise ConfigError(
                f"{source}: no scalar {self.name!r} for {self.parameter.name}{suggest(self.name, scalars)}"
            )
        return _quantity(f"{scalars[self.name]!r} {self.unit}", self.parameter)


@dataclass(frozen=True)
class Uncertain:
    """A parameter with a prior; ``maximum`` as a location is the observed maximum in the window."""

    parameter: Parameter
    spec: schema.Prior

    @property
    def needs_data(self) -> bool:
        return "maximum" in (self.spec.mean, self.spec.median)

    def term(self, maximum: float | None = None) -> PriorTerm:
        """The prior; ``maximum`` is in the parameter's unit. Raises :class:`ConfigError`, its path the faulty key."""
        spec, parameter = self.spec, self.parameter
        given = frozenset(spec.model_fields_set - {"prior"})
        mean, median = self._location("mean", maximum), self._location("median", maximum)
        if spec.prior == "normal" and given == {"mean", "std"}:
            return PriorTerm.normal(parameter, mean, self._spread(mean))
        if spec.prior == "lognormal" and given == {"mean", "std"}:
            return PriorTerm.lognormal_moments(parameter, mean, self._spread(mean))
        if spec.prior == "lognormal" and given == {"median", "log_std"} and spec.log_std is not None:
            return PriorTerm.lognormal(parameter, median, spec.log_std)
        if spec.prior == "logit" and given == {"lower", "upper", "median", "logit_std"} and spec.logit_std is not None:
            bounds = self._location("lower", maximum), self._location("upper", maximum)
            return PriorTerm.logit(parameter, bounds, median, spec.logit_std)
        takes, has = _RECIPES[spec.prior], ", ".join(sorted(given)) or "none of these"
        raise ConfigError(f"a {spec.prior} prior takes {takes}; given: {has}")

    def _location(self, key: str, maximum: float | None) -> float:
        value = getattr(self.spec, key)
        if value is None:
            return 0.0
        if value == "maximum":
            if maximum is None:
                raise ConfigError([Fault("'maximum' is known only from the data, and there are none", key)])
            return maximum
        return _quantity(value, self.parameter, key)

    def _spread(self, mean: float) -> float:
        text = self.spec.std
        percent = _PERCENT.fullmatch(str(text))
        try:
            std = 0.01 * parse_quantity(percent[1], "1") * abs(mean) if percent else None
            std = parse_quantity(text or 0, self.parameter.unit) if std is None else std
        except UnitError as error:
            raise ConfigError([Fault(str(error), "std")]) from None
        if percent and mean == 0:
            unit = self.parameter.unit
            raise ConfigError([Fault(f"{text} is relative to the mean, which is zero; give it in {unit}", "std")])
        if not std > 0:
            raise ConfigError([Fault(f"must be positive, not {text}", "std")])
        return std


Entry = Fixed | Scalar | Uncertain


def read_parameters(
    raw: Mapping[str, Any], model: ForwardModel, document: Document, faults: list[Fault]
) -> tuple[Entry, ...]:
    """One entry for every parameter of the model, in its order, then t_s and sigma if given. Faults are appended."""
    shift = replace(TIME_SHIFT, unit=model.time_unit, display_unit=model.time_display_unit)
    known = {p.name: p for p in (shift, NOISE_SCALE, *model.parameters)}  # a model's own sigma goes before
    known = {p.name: known[p.name] for p in (*model.parameters, shift, NOISE_SCALE)}
    defaults: Mapping[str, float] = getattr(model, "defaults", {})
    for name in raw:
        if name not in known:
            faults.append(
                document.fault(("parameters", name), f"unknown parameter {name!r}{suggest(name, known)}", at_key=True)
            )
    entries: list[Entry] = []
    for name, parameter in known.items():
        if name in raw:
            entry = _entry(raw[name], parameter, document, faults)
            entries += [entry] if entry else []
        elif name in defaults:
            entries.append(Fixed(parameter, defaults[name]))
        elif parameter not in (shift, NOISE_SCALE):
            faults.append(document.fault(("parameters", name), _missing(parameter)))
    return tuple(entries)


def _missing(parameter: Parameter) -> str:
    unit = "" if parameter.unit == "1" else f" {parameter.unit}"
    return (
        f"{parameter.label} {parameter.name!r} (unit {parameter.unit}) has neither a prior nor a value; "
        f"write e.g. '{parameter.name}: {{prior: normal, mean: 1{unit}, std: 0.1{unit}}}' or a fixed quantity"
    )


def _entry(raw: Any, parameter: Parameter, document: Document, faults: list[Fault]) -> Entry | None:
    path = ("parameters", parameter.name)
    try:
        if not isinstance(raw, dict):
            return Fixed(parameter, _quantity(raw, parameter))
        if "from_file" in raw:
            scalar = check(schema.FromFile, raw, path, document, faults)
            if scalar is None:
                return None
            convert(1.0, scalar.unit, parameter.unit)
            return Scalar(parameter, scalar.from_file, scalar.unit)
        prior = check(schema.Prior, raw, path, document, faults)
        if prior is None:
            return None
        entry = Uncertain(parameter, prior)
        if not entry.needs_data:
            entry.term()
        elif prior.prior != "logit":
            entry.term(maximum=1.0)  # the other values do not wait for the data
        return entry
    except ConfigError as error:
        faults += [located(document, path, fault) for fault in error.problems]
    except UnitError as error:
        faults.append(document.fault(path, str(error)))
    return None


def located(document: Document, path: tuple[str, ...], fault: Fault) -> Fault:
    """A fault whose path is a key inside the parameter at ``path``, placed in the file."""
    message = fault.message.removeprefix(f"prior of {path[-1]}: ")
    return document.fault((*path, fault.path) if fault.path else path, message)


def _quantity(value: str | float, parameter: Parameter, key: str = "") -> float:
    """A value in the parameter's unit and inside its bounds. Raises :class:`ConfigError` with the path ``key``."""
    low, high = parameter.bounds
    try:
        number = parse_quantity(value, parameter.unit)
    except UnitError as error:
        raise ConfigError([Fault(str(error), key)]) from None
    if not low <= number <= high:
        raise ConfigError([Fault(f"{value} is outside the bounds [{low:g}, {high:g}] {parameter.unit}", key)])
    return number
