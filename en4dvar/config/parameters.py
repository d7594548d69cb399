"""The ``parameters:`` section: what is estimated, what is fixed, and what waits for a number from the data file."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field

from en4dvar.config.context import Context, Faults, Made, read_each
from en4dvar.config.quantities import SPREAD, Spread, share_of, subject_unit, unit_of
from en4dvar.config.schema import Section
from en4dvar.config.varies import Estimated, VariesSection
from en4dvar.model.forward import ForwardModel
from en4dvar.model.state import OF_READINGS, READING_OFFSET, TIME_SHIFT, Array, Parameter
from en4dvar.plumbing.errors import ConfigError, retold
from en4dvar.plumbing.hints import brief, shown, suggest
from en4dvar.plumbing.units import parse_quantity, unit_after
from en4dvar.priors.prior import PriorTerm
from en4dvar.priors.varying.model import can_vary

_RECIPES = {
    "normal": "mean and std, and may have lower, upper or both",
    "lognormal": "median and log_std, which may have upper, or lower and upper, or mean and std",
    "logit": "lower, upper, median and logit_std",
    "uniform": "lower and upper",
    "half-normal": "std, and lower where it does not start at zero",
    "beta": "lower, upper, alpha and beta",
    "ensemble": "map and unit, both where they are needed, and no number of its own",
}


def _bounded(text: Any, parameter: Parameter) -> float:
    """A value in the parameter's unit. Raises :class:`ConfigError`, :class:`UnitError`."""
    return inside_bounds(parse_quantity(text, parameter.unit, parameter.display_unit), parameter, text)


def inside_bounds(value: float, parameter: Parameter, written: Any = "") -> float:
    """The value, in the parameter's unit. Raises :class:`ConfigError` with it as it is ``written``."""
    low, high = parameter.bounds
    if not low <= value <= high:
        words = brief(str(written), 80) or f"{value:g} {parameter.unit}"
        raise ConfigError(f"{words} is outside the bounds [{low:g}, {high:g}] {parameter.unit}")
    return value


Value = Annotated[float | None, Made(lambda text, context: _bounded(text, context.subject))]


class FromFile(Section):
    """A scalar that the data file holds."""

    from_file: Annotated[str, Field(min_length=1)]
    """Name of a scalar in the data file, e.g. Req, or of a column with one value a data set (data.by)."""
    unit: Annotated[str, unit_of(subject_unit)]
    """Unit of that scalar in the file."""


@dataclass(frozen=True)
class Scalar:
    """A parameter held at a scalar of the data file."""

    needs_data: ClassVar[bool] = True
    parameter: Parameter
    name: str
    unit: str

    @classmethod
    def of(cls, written: Any, context: Context) -> "Scalar":
        scalar = FromFile.model_validate(written, context=context)
        return cls(context.subject, scalar.from_file, scalar.unit)

    def value(self, scalars: Mapping[str, float], source: str) -> float:
        """The value in the parameter's unit. Raises :class:`ConfigError` when the file does not hold it."""
        if self.name not in scalars:
            hint = suggest(self.name, scalars)
            raise ConfigError(f"{source}: no scalar {self.name!r} for {self.parameter.name}{hint}")
        return _bounded(f"{scalars[self.name]!r} {self.unit}", self.parameter)


READINGS: Mapping[str, Callable[[Array], float]] = {"maximum": lambda y: float(y.max()), "first": lambda y: float(y[0])}
"""Of the observations (K,) of a window, those whose share a prior's location may be."""


def _location(written: Any, context: Context) -> float | Spread | Scalar:
    """Of a prior: a quantity, one of :data:`READINGS` or a share of it, or a scalar of the data file."""
    if isinstance(written, dict):
        return Scalar.of(written, context)
    share = share_of(f"100 % of {written}" if written in [*READINGS] else written, *READINGS)
    return _bounded(written, context.subject) if share is None else share


Location = Annotated[float | Spread | Scalar | None, Made(_location)]


class PriorSection(Section):
    """A prior by name; locations and spreads carry the parameter's unit, a ``%`` spread is relative to the location."""

    prior: Literal["normal", "lognormal", "logit", "uniform", "half-normal", "beta", "ensemble"]
    """Shape: normal (mean, std), lognormal (median and log_std, or mean and std), each also cut off at lower and upper
    (a normal: or at one of them alone; a lognormal: or at upper alone), logit (lower, upper, median, …),
    uniform (lower, upper), half-normal (std, and lower, by default 0), beta (lower, upper, alpha, beta), or ensemble:
    mean, spread and correlations are those of the members in the file of ``prior: {ensemble: FILE}``."""
    mean: Location = None
    """Mean with its unit, or ``maximum`` or ``first``, the largest or first observation of the window, or a share of
    it, ``13 % of maximum``."""
    median: Location = None
    """Median with its unit, or ``maximum`` or ``first``, the largest or first observation of the window, or a share of
    it, ``13 % of maximum``."""
    std: Annotated[Spread | None, SPREAD] = None
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
    """For ``prior: ensemble``: the coordinate in which its members count as Gaussian; default: the parameter's own."""
    unit: Annotated[str | None, unit_of(subject_unit)] = None
    """For ``prior: ensemble``: unit of the numbers in the file, if the file does not say it."""
    varies: VariesSection | None = None
    """The parameter varies in time; the prior is that of its first piece."""
    shared: Annotated[str | None, Field(min_length=1)] = None
    """The data sets have one value of it, estimated together after each by itself: ``all`` of them, or those of one
    group of a kind in ``groups:``, e.g. batch. ``none``: each has a value of its own, of a constant of medium or camera
    too, which otherwise has one value in all."""


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

    def check(self, parameters: "Mapping[str, Entry]", own: Sequence[str]) -> None:
        """Raise :class:`ConfigError` where it cannot follow; ``own`` are the names of the model's parameters."""
        name, other = self.parameter.name, parameters.get(self.to)
        if name not in own:
            raise ConfigError(f"{name} is not a parameter of the model and cannot be tied")
        if other is None or self.to not in own or self.to == name:
            names = [candidate for candidate in parameters if candidate in own and candidate != name]
            raise ConfigError(f"{self.to!r} is not another parameter of the model{suggest(self.to, names)}", "tied")
        if isinstance(other, Tied):
            raise ConfigError(f"{self.to} is tied itself; tie {name} to a parameter with a prior or a value", "tied")
        if isinstance(other, Uncertain) and other.spec.varies is not None:
            raise ConfigError(f"{self.to} varies in time, and another parameter cannot be tied to that", "tied")
        if other.parameter.unit != self.parameter.unit:
            units = f"{other.parameter.unit}, {name} in {self.parameter.unit}"
            raise ConfigError(f"{self.to} is in {units}", "tied")


@dataclass(frozen=True)
class Fixed:
    """A parameter held at ``value`` (its own unit)."""

    needs_data: ClassVar[bool] = False
    parameter: Parameter
    value: float


@dataclass(frozen=True)
class Uncertain:
    """A parameter with a prior. ``of_members`` is the prior that an ensemble makes, once its file is read."""

    parameter: Parameter
    spec: PriorSection
    of_members: PriorTerm | None = None

    @property
    def needs_data(self) -> bool:
        return any(isinstance(where, Spread | Scalar) for where in (self.spec.mean, self.spec.median))

    def term(self, of_data: Callable[[Spread | Scalar], float] | None = None) -> PriorTerm:
        """The prior; ``of_data``: what a file says, in its unit. Raises :class:`ConfigError`, its path the key."""
        try:
            return self._term(self._location("mean", of_data), self._location("median", of_data))
        except ConfigError as error:
            own = f"prior of {self.parameter.name}: "
            raise ConfigError([replace(f, message=f.message.removeprefix(own)) for f in error.problems]) from None

    def _term(self, mean: float, median: float) -> PriorTerm:
        spec, p, missing = self.spec, self.parameter, math.inf if self.spec.prior == "normal" else 0.0
        bounds = -missing if spec.lower is None else spec.lower, missing if spec.upper is None else spec.upper
        if self.of_members is not None:
            return self.of_members
        log_std, logit_std = spec.log_std or 0.0, spec.logit_std or 0.0  # each is there where it is read
        makers: dict[str, Callable[[], PriorTerm]] = {
            "normal mean std": lambda: PriorTerm.normal(p, mean, self._std(mean)),
            **dict.fromkeys(
                ("normal lower mean std", "normal mean std upper", "normal lower mean std upper"),
                lambda: PriorTerm.bounded(p, "normal", mean, self._std(mean), bounds),
            ),
            "lognormal mean std": lambda: PriorTerm.lognormal_moments(p, mean, self._std(mean)),
            "lognormal log_std median": lambda: PriorTerm.lognormal(p, median, log_std),
            "lognormal log_std median upper": lambda: PriorTerm.bounded(p, "lognormal", median, log_std, bounds),
            "lognormal log_std lower median upper": lambda: PriorTerm.bounded(p, "lognormal", median, log_std, bounds),
            "logit logit_std lower median upper": lambda: PriorTerm.logit(p, bounds, median, logit_std),
            "uniform lower upper": lambda: PriorTerm.uniform(p, bounds),
            "half-normal std": lambda: PriorTerm.half_normal(p, self._std(0.0)),
            "half-normal lower std": lambda: PriorTerm.half_normal(p, self._std(0.0), bounds[0]),
            "beta alpha beta lower upper": lambda: PriorTerm.beta(p, bounds, spec.alpha or 0.0, spec.beta or 0.0),
        }
        make = makers.get(" ".join([spec.prior, *sorted(self._given)]))
        if make is None:
            raise self._recipe()
        return make()

    @property
    def _given(self) -> set[str]:
        return self.spec.model_fields_set - {"prior", "varies", "shared"}

    def _recipe(self) -> ConfigError:
        kind, has = self.spec.prior, ", ".join(sorted(self._given)) or "none of these"
        return ConfigError(f"{'an' if kind == 'ensemble' else 'a'} {kind} prior takes {_RECIPES[kind]}; given: {has}")

    def check(self) -> None:
        """Raise :class:`ConfigError` for what can be told without data and files."""
        if self.spec.prior == "ensemble":
            if not self._given <= {"map", "unit"}:
                raise self._recipe()
        elif not self.needs_data:
            self.term()
        elif self.spec.prior != "logit":
            self.term(lambda where: 1.0)  # the other values do not wait for the data

    def _location(self, key: Literal["mean", "median"], of_data: Callable[[Spread | Scalar], float] | None) -> float:
        value: float | Spread | Scalar | None = getattr(self.spec, key)
        if not isinstance(value, Spread | Scalar):
            return value or 0.0
        if of_data is None:
            name = value.name if isinstance(value, Scalar) else value.whole
            raise ConfigError(f"{name!r} is known only from the data, and there are none", key)
        with retold(ConfigError, ConfigError, "", key):
            return of_data(value)

    def _std(self, mean: float) -> float:
        std = self.spec.std
        if std is None:
            return 0.0
        if std.relative and mean == 0:
            message = f"{100 * std.value:g} % is relative to the mean, which is zero; give it in {self.parameter.unit}"
            raise ConfigError(message, "std")
        return std.absolute(mean)


Entry = Fixed | Scalar | Uncertain | Tied


def _entry(written: Any, context: Context) -> Entry:
    """A quantity, a scalar of the data file, or a prior. Raises :class:`ConfigError`, ``ValueError``."""
    parameter = context.subject
    if not isinstance(written, dict):
        return Fixed(parameter, _bounded(written, parameter))
    if "from_file" in written:
        return Scalar.of(written, context)
    if "tied" in written:
        tied = TiedSection.model_validate(written, context=context)
        return Tied(parameter, tied.tied, tied.factor)
    spec = PriorSection.model_validate(written, context=context)
    entry = Uncertain(replace(parameter, common=parameter.common and spec.shared != "none"), spec)
    if entry.spec.varies is not None and not can_vary(context.model, parameter.name):
        raise ConfigError(f"{parameter.name} cannot vary: {_why_not(context.model, parameter)}", "varies")
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
    unit = unit_after(parameter.display_unit)
    return (
        f"{parameter.label} {parameter.name!r} (unit {parameter.display_unit}) has neither a prior nor a value; "
        f"write e.g. '{parameter.name}: {{prior: normal, mean: 1{unit}, std: 0.1{unit}}}' or a fixed quantity"
    )


def _of_an_estimation(entry: Entry, model: ForwardModel, data: bool) -> Iterator[tuple[tuple[str, ...], str]]:
    """Keys of an entry that an estimation alone knows, each with what a file of another kind lacks; ``data``: it has
    data, from which the state is estimated.
    """
    if entry.needs_data and not data:
        yield (), "has no data file to take a value from"
    if isinstance(entry, Tied):
        yield ("tied",), "has no tied parameters; give a value or a prior"
    if isinstance(entry, Uncertain):
        name, varies = entry.parameter.name, entry.spec.varies
        if entry.spec.prior == "ensemble":
            yield ("prior",), "has no ensemble of its own; give it another prior"
        if varies is not None and not data:
            yield ("varies",), "has constant parameters"
        elif varies is not None and isinstance(varies.std, Estimated):
            yield ("varies",), "does not estimate the std of a walk; give it in % or in the unit of the parameter"
        if entry.spec.shared is not None:
            yield ("shared",), "estimates no data sets together"
        if data and name not in model.layout.names:
            yield (), f"estimates by a field of the state, and the model has no field {name!r}; give it a value"


def entries(kind: str = "", data: bool = False) -> Made:
    """One entry for every parameter of the model, in its order, then those of the readings if given. ``kind``: what the
    file is, where it is no estimation; ``data``: it names some, from which a value may come.
    """

    def read(section: Mapping[str, Any], context: Context) -> tuple[Entry, ...]:
        model = context.model
        shift = replace(TIME_SHIFT, unit=model.time_unit, display_unit=model.time_display_unit)
        seen = context.observed
        offset = replace(READING_OFFSET, unit=seen.unit, display_unit=seen.display_unit) if seen else READING_OFFSET
        known = {p.name: p for p in model.parameters}
        of_readings = {p.name: p for p in (*OF_READINGS, shift, offset) if p.name not in known}  # a model's own first
        known |= {} if kind else of_readings
        labels = {p.name: p.label for p in (*known.values(), *model.optional_parameters)}

        def unknown(name: str) -> str:
            if kind and name in of_readings:
                words = "knows parameters of the model alone: neither time shift nor noise scale"
                made = "makes its own readings: keys of their own say when and with which errors"
                return f"{kind} {words if data else made}"
            needed = model.absent_parameters.get(name)
            hint = f"; the model has it only with {needed}" if needed else suggest(name, labels)
            return f"unknown parameter {shown(name)}{hint}"

        defaults = {name: float(value) for name, value in model.defaults.items() if name in known}
        parameters: dict[str, Entry] = {name: Fixed(known[name], value) for name, value in defaults.items()}
        with Faults() as faults:
            parameters |= read_each(section, known, context, faults, _entry, unknown)
            for name, entry in parameters.items():
                if isinstance(entry, Tied) and (entry.to in parameters or entry.to not in section):  # else that is told
                    with faults.at(name):
                        entry.check(parameters, [p.name for p in model.parameters])
                for key, lacking in _of_an_estimation(entry, model, data) if kind else ():
                    faults.add((name, *key), f"{kind} {lacking}")
            for parameter in model.parameters:
                if parameter.name not in {**section, **model.defaults}:
                    faults.add((parameter.name,), _missing(parameter))
        return tuple(parameters[name] for name in known if name in parameters)

    json = {"type": "object", "additionalProperties": {"x-definition": "parameter"}}
    return Made(read, dict[str, Any], json)
