"""The ``parameters:`` section: what is estimated, what is fixed, and what waits for a number from the data file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from en4dvar.config.context import (
    Context,
    Made,
    Spread,
    parse_spread,
    read_each,
    subject_unit,
    unit_of,
)
from en4dvar.config.schema import Section
from en4dvar.config.validate import Faults
from en4dvar.config.varies import VariesSection
from en4dvar.errors import ConfigError, Fault
from en4dvar.forward import ForwardModel
from en4dvar.hints import brief, shown, suggest
from en4dvar.prior import PriorTerm
from en4dvar.state import OF_READINGS, READING_OFFSET, TIME_SHIFT, Array, Parameter
from en4dvar.units import parse_quantity
from en4dvar.varying import RandomWalk
from en4dvar.varying.model import can_vary

_RECIPES = {
    "normal": "mean and std",
    "lognormal": "median and log_std, or mean and std",
    "logit": "lower, upper, median and logit_std",
    "uniform": "lower and upper",
    "half-normal": "std, and lower where it does not start at zero",
    "beta": "lower, upper, alpha and beta",
    "ensemble": "map and unit, both where they are needed, and no number of its own",
}


def _bounded(text: Any, parameter: Parameter) -> float:
    """A value in the parameter's unit. Raises :class:`ConfigError`, :class:`UnitError`."""
    return inside_bounds(parse_quantity(text, parameter.unit), parameter, brief(str(text), 80))


def inside_bounds(value: float, parameter: Parameter, shown: str = "") -> float:
    """The value, in the parameter's unit. Raises :class:`ConfigError` with it as ``shown``."""
    low, high = parameter.bounds
    if not low <= value <= high:
        words = shown or f"{value:g} {parameter.unit}"
        raise ConfigError(f"{words} is outside the bounds [{low:g}, {high:g}] {parameter.unit}")
    return value


Value = Annotated[float | None, Made(lambda text, context: _bounded(text, context.subject))]
Location = Annotated[
    float | Literal["maximum"] | None,
    Made(lambda text, context: text if text == "maximum" else _bounded(text, context.subject)),
]


class PriorSection(Section):
    """A prior by name; locations and spreads carry the parameter's unit, a ``%`` spread is relative to the location."""

    prior: Literal["normal", "lognormal", "logit", "uniform", "half-normal", "beta", "ensemble"]
    """Shape: normal (mean, std), lognormal (median and log_std, or mean and std), logit (lower, upper, median, …),
    uniform (lower, upper), half-normal (std, and lower, by default 0), beta (lower, upper, alpha, beta), or ensemble:
    mean, spread and correlations are those of the members in the file of ``prior: {ensemble: FILE}``."""
    mean: Location = None
    """Mean with its unit, or ``maximum``: the largest observation of the window."""
    median: Location = None
    """Median with its unit, or ``maximum``: the largest observation of the window."""
    std: Annotated[Spread | None, Made(lambda text, context: parse_spread(text, subject_unit(context)))] = None
    """Standard deviation with its unit, or in % of the mean; of a half-normal, that of the whole Gaussian."""
    log_std: Annotated[float, Field(gt=0)] | None = None
    """Standard deviation of the natural logarithm: 0.3 is about 30 %, 0.7 a factor of two."""
    logit_std: Annotated[float, Field(gt=0)] | None = None
    """Standard deviation of the logit between ``lower`` and ``upper``."""
    lower: Value = None
    """Lower bound with its unit; never reached."""
    upper: Value = None
    """Upper bound with its unit; never reached."""
    alpha: Annotated[float, Field(gt=0)] | None = None
    """First exponent of a beta: probability leans to ``upper`` where it is the larger one."""
    beta: Annotated[float, Field(gt=0)] | None = None
    """Second exponent of a beta."""
    map: Literal["normal", "lognormal", "logit"] | None = None
    """Of an ensemble: in which coordinate its members are taken as Gaussian; by default the parameter's own."""
    unit: Annotated[str | None, unit_of(subject_unit)] = None
    """Of an ensemble: unit of the numbers in the file, where that does not tell it."""
    varies: VariesSection | None = None
    """The parameter varies in time; the prior is that of its first piece."""
    shared: Annotated[str | None, Field(min_length=1)] = None
    """The data sets have one value of it, estimated together after each by itself: ``all`` of them, or those of one
    group of a kind in ``groups:``, e.g. gel."""


class FromFile(Section):
    """A value fixed at a scalar that the data file holds."""

    from_file: Annotated[str, Field(min_length=1)]
    """Name of a scalar in the data file, e.g. Req."""
    unit: Annotated[str, unit_of(subject_unit)]
    """Unit of that scalar in the file."""


class TiedSection(Section):
    """A parameter that has the value of another one, or a multiple of it."""

    tied: Annotated[str, Field(min_length=1)]
    """Name of the other parameter, which has a prior or a value."""
    factor: float = 1.0
    """Multiple of it."""


@dataclass(frozen=True)
class Tied:
    """A parameter that is ``factor`` times the one named ``to``."""

    needs_data: ClassVar[bool] = False
    parameter: Parameter
    to: str
    factor: float

    def check(self, found: Mapping[str, Entry], own: Sequence[str]) -> None:
        """Raise :class:`ConfigError` where it cannot follow; ``own`` are the names of the model's parameters."""
        name, other = self.parameter.name, found.get(self.to)
        if name not in own:
            raise ConfigError(f"{name} is no parameter of the model and cannot be tied")
        if other is None or self.to not in own or self.to == name:
            names = [one for one in found if one in own and one != name]
            raise ConfigError(
                [Fault(f"{self.to!r} is no other parameter of the model{suggest(self.to, names)}", "tied")]
            )
        if isinstance(other, Tied):
            raise ConfigError(
                [Fault(f"{self.to} is tied itself; tie {name} to a parameter with a prior or a value", "tied")]
            )
        if isinstance(other, Uncertain) and other.spec.varies is not None:
            raise ConfigError([Fault(f"{self.to} varies in time, and nothing can follow that", "tied")])
        if other.parameter.unit != self.parameter.unit:
            units = f"{other.parameter.unit}, {name} in {self.parameter.unit}"
            raise ConfigError([Fault(f"{self.to} is in {units}", "tied")])


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
        return _bounded(f"{scalars[self.name]!r} {self.unit}", self.parameter)


@dataclass(frozen=True)
class Uncertain:
    """A parameter with a prior; ``maximum`` as a location is the observed maximum in the window.

    ``of_members`` is the prior that an ensemble makes, once its file is read.
    """

    parameter: Parameter
    spec: PriorSection
    of_members: PriorTerm | None = None

    @property
    def from_ensemble(self) -> bool:
        """Whether the prior is that of the members in a file."""
        return self.spec.prior == "ensemble"

    @property
    def needs_data(self) -> bool:
        return "maximum" in (self.spec.mean, self.spec.median)

    def term(self, maximum: float | None = None) -> PriorTerm:
        """The prior; ``maximum`` is in the parameter's unit. Raises :class:`ConfigError`, its path the faulty key."""
        try:
            return self._term(self._location("mean", maximum), self._location("median", maximum))
        except ConfigError as error:
            own = f"prior of {self.parameter.name}: "
            raise ConfigError([replace(f, message=f.message.removeprefix(own)) for f in error.problems]) from None

    def _term(self, mean: float, median: float) -> PriorTerm:
        spec, parameter = self.spec, self.parameter
        given = self._given
        if self.of_members is not None:
            return self.of_members
        if spec.prior == "normal" and given == {"mean", "std"}:
            return PriorTerm.normal(parameter, mean, self._std(mean))
        if spec.prior == "lognormal" and given == {"mean", "std"}:
            return PriorTerm.lognormal_moments(parameter, mean, self._std(mean))
        if spec.prior == "lognormal" and given == {"median", "log_std"} and spec.log_std is not None:
            return PriorTerm.lognormal(parameter, median, spec.log_std)
        if spec.prior == "logit" and given == {"lower", "upper", "median", "logit_std"} and spec.logit_std is not None:
            return PriorTerm.logit(parameter, self._bounds, median, spec.logit_std)
        if spec.prior == "uniform" and given == {"lower", "upper"}:
            return PriorTerm.uniform(parameter, self._bounds)
        if spec.prior == "half-normal" and given - {"lower"} == {"std"}:
            return PriorTerm.half_normal(parameter, self._std(0.0), spec.lower or 0.0)
        if spec.prior == "beta" and given == {"lower", "upper", "alpha", "beta"} and spec.alpha and spec.beta:
            return PriorTerm.beta(parameter, self._bounds, spec.alpha, spec.beta)
        raise self._recipe()

    @property
    def _given(self) -> set[str]:
        return self.spec.model_fields_set - {"prior", "varies", "shared"}

    def _recipe(self) -> ConfigError:
        takes, has = _RECIPES[self.spec.prior], ", ".join(sorted(self._given)) or "none of these"
        return ConfigError(f"{'an' if self.from_ensemble else 'a'} {self.spec.prior} prior takes {takes}; given: {has}")

    def check(self) -> None:
        """Raise :class:`ConfigError` for what can be told without data and files."""
        if self.from_ensemble:
            if not self._given <= {"map", "unit"}:
                raise self._recipe()
        elif not self.needs_data:
            self.term()
        elif self.spec.prior != "logit":
            self.term(maximum=1.0)  # the other values do not wait for the data

    @property
    def _bounds(self) -> tuple[float, float]:
        return self.spec.lower or 0.0, self.spec.upper or 0.0

    def walk(self, model: ForwardModel, term: PriorTerm, times: Array) -> RandomWalk | None:
        """How it varies over a window of observations at ``times`` (K,); None where it does not.

        Raises :class:`ConfigError`, its path the faulty key.
        """
        varies = self.spec.varies
        if varies is None:
            return None
        centre = float(term.to_physical(np.array(term.mean)))
        if varies.std.relative and centre == 0:
            message = f"relative to the mean, which is zero; give it in {self.parameter.unit}"
            raise ConfigError([Fault(message, "varies.std")])
        try:
            std = varies.std.absolute(centre) / term.slope(term.mean)
            return RandomWalk.of(model, term, varies.knots(times), std, varies.estimated)
        except ConfigError as error:
            raise ConfigError(
                [replace(f, path=f"varies.{f.path}" if f.path else "varies") for f in error.problems]
            ) from None

    def _location(self, key: Literal["mean", "median"], maximum: float | None) -> float:
        value: float | Literal["maximum"] | None = getattr(self.spec, key)
        if value != "maximum":
            return value or 0.0
        if maximum is None:
            raise ConfigError([Fault("'maximum' is known only from the data, and there are none", key)])
        return maximum

    def _std(self, mean: float) -> float:
        std = self.spec.std
        if std is None:
            return 0.0
        if std.relative and mean == 0:
            message = f"{100 * std.value:g} % is relative to the mean, which is zero; give it in {self.parameter.unit}"
            raise ConfigError([Fault(message, "std")])
        return std.absolute(mean)


Entry = Fixed | Scalar | Uncertain | Tied


def _entry(given: Any, context: Context) -> Entry:
    """A quantity, a scalar of the data file, or a prior. Raises :class:`ConfigError`, ``ValueError``."""
    parameter = context.subject
    if not isinstance(given, dict):
        return Fixed(parameter, _bounded(given, parameter))
    if "from_file" in given:
        scalar = FromFile.model_validate(given, context=context)
        return Scalar(parameter, scalar.from_file, scalar.unit)
    if "tied" in given:
        tied = TiedSection.model_validate(given, context=context)
        return Tied(parameter, tied.tied, tied.factor)
    entry = Uncertain(parameter, PriorSection.model_validate(given, context=context))
    if entry.spec.varies is not None and not can_vary(context.model, parameter.name):
        raise ConfigError([Fault(f"{parameter.name} cannot vary: {_why_not(context.model, parameter)}", "varies")])
    entry.check()
    return entry


def _why_not(model: ForwardModel, parameter: Parameter) -> str:
    if parameter not in model.parameters:
        return "it is no parameter of the model"
    if not model.resumable:
        return "the model has no step, so that it cannot go on from its state at a knot"
    if parameter.name not in model.layout.names:
        return f"the state of the model has no field {parameter.name!r} that could be changed on the way"
    acting = ", ".join(model.path_parameters)
    return f"it acts at the start alone; those that act along the path are {acting}"


def _missing(parameter: Parameter) -> str:
    unit = "" if parameter.unit == "1" else f" {parameter.unit}"
    return (
        f"{parameter.label} {parameter.name!r} (unit {parameter.unit}) has neither a prior nor a value; "
        f"write e.g. '{parameter.name}: {{prior: normal, mean: 1{unit}, std: 0.1{unit}}}' or a fixed quantity"
    )


def entries(kind: str = "") -> Made:
    """One entry for every parameter of the model, in its order, then those of the readings if given.

    ``kind``: what the file is, where it names no data from which a value could come.
    """

    def read(given: Mapping[str, Any], context: Context) -> tuple[Entry, ...]:
        model = context.model
        shift = replace(TIME_SHIFT, unit=model.time_unit, display_unit=model.time_display_unit)
        seen = context.observed
        offset = replace(READING_OFFSET, unit=seen.unit, display_unit=seen.display_unit) if seen else READING_OFFSET
        known = {p.name: p for p in model.parameters}
        of_readings = {p.name: p for p in (*OF_READINGS, shift, offset) if p.name not in known}  # a model's own first
        known |= {} if kind else of_readings
        labels = {p.name: p.label for p in (*known.values(), *model.optional_parameters)}
        defaults: Mapping[str, float] = getattr(model, "defaults", {})

        def unknown(name: str) -> str:
            if kind and name in of_readings:
                return f"{kind} makes its own readings: keys of their own say when and with which errors"
            return f"unknown parameter {shown(name)}{suggest(name, labels)}"

        found: dict[str, Entry] = {name: Fixed(known[name], value) for name, value in defaults.items()}
        with Faults() as faults:
            found |= read_each(given, known, context, faults, _entry, unknown)
            for name, entry in found.items():
                if kind and entry.needs_data:
                    faults.add((name,), f"{kind} has no data file to take a value from")
                if isinstance(entry, Tied) and (entry.to in found or entry.to not in given):  # else that is told
                    with faults.at(name):
                        entry.check(found, [p.name for p in model.parameters])
                if kind and isinstance(entry, Tied):
                    faults.add((name, "tied"), f"{kind} has no tied parameters; give a value or a prior")
                if kind and isinstance(entry, Uncertain) and entry.from_ensemble:
                    faults.add((name, "prior"), f"{kind} has no ensemble of its own; give it another prior")
                if kind and isinstance(entry, Uncertain) and entry.spec.varies is not None:
                    faults.add((name, "varies"), f"{kind} has constant parameters")
                if kind and isinstance(entry, Uncertain) and entry.spec.shared is not None:
                    faults.add((name, "shared"), f"{kind} estimates no data sets together")
            for parameter in model.parameters:
                if parameter.name not in {**given, **defaults}:
                    faults.add((parameter.name,), _missing(parameter))
        return tuple(found[name] for name in known if name in found)

    json = {"type": "object", "additionalProperties": {"x-definition": "parameter"}}
    return Made(read, dict[str, Any], json)
