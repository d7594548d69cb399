"""What is said of each reading: how well it is known and what the model misses (``data.error``), its weight
(``data.weights``) and its place (``data.places``).
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BeforeValidator, ConfigDict, Field, TypeAdapter

from en4dvar.config.context import PLACEHOLDER, TEXT, Context, Faults, Made
from en4dvar.config.quantities import Spread, Unit, observable_unit, quantity, read_spread, share_of, time_unit, unit_of
from en4dvar.config.schema import OfReadings, Section
from en4dvar.data.extrema import minima
from en4dvar.data.noise import SMOOTHNESS, Kernel
from en4dvar.data.series import Places
from en4dvar.inputs.parts import Column, Matrix
from en4dvar.model.forward import field_of
from en4dvar.model.state import Array, Parameter
from en4dvar.model.state import Field as StateBlock
from en4dvar.plumbing import user_file
from en4dvar.plumbing.errors import ConfigError, DataError, retold
from en4dvar.plumbing.files import PathError, expanded
from en4dvar.plumbing.hints import shown
from en4dvar.plumbing.units import UnitError, convert, parse_quantity
from en4dvar.plumbing.user_code import loading, reason_of
from en4dvar.priors.prior import PriorTerm


class InUnit(OfReadings):
    """A column of standard deviations or of places, one per reading."""

    unit: str | None = None
    """Unit of the numbers in it; default: that of the readings' own column, and of places none: these are indices,
    counted from 0."""


def or_column(read: Callable[[Any, Context], Any], unit: Unit) -> Callable[[Any, Context], Any]:
    """``read``, but of a section that names a column in ``unit`` this :class:`Column`."""

    def read_either(written: Any, context: Context) -> Any:
        if not isinstance(written, Mapping):
            return read(written, context)
        chosen = InUnit.model_validate(written, context=context)
        if chosen.unit is not None:
            convert(1.0, chosen.unit, unit(context))
        return Column(chosen.column, chosen.unit or "", unit(context))

    return read_either


read_error_std = or_column(read_spread, observable_unit)
_TIME_STD = quantity(time_unit, "not negative", error=True)


def _time_std(text: Any, context: Context) -> float | Spread:
    return share_of(text, "step", sign="not negative") or _TIME_STD.make(text, context)


read_time_std = or_column(_time_std, time_unit)


def _shared(written: Any, context: Context) -> tuple[Spread | Column, ...]:
    parts = [read_error_std(part, context) for part in (written if isinstance(written, list) else [written])]
    return tuple(replace(part, kind="shared") if isinstance(part, Column) else part for part in parts)


MARKS = Made(
    lambda mark, context: mark if isinstance(mark, bool) else Column(mark.column, "1", "1", kind="mark"),
    bool | OfReadings,
)
QUANTITY_OR_COLUMN = {"anyOf": [TEXT, InUnit.model_json_schema()]}

LogStd = Annotated[float, Field(gt=0), "Standard deviation of the natural logarithm."]


class AmplitudeSection(Section):
    """Lognormal prior of ``discrepancy_amplitude``, the discrepancy's standard deviation."""

    median: Annotated[Spread, Made(read_spread)] = Field("0.5 % of maximum", validate_default=True)
    """A quantity in the observable's unit, or e.g. '2 % of maximum'."""
    log_std: LogStd = 1.5


class LengthSection(Section):
    """Lognormal prior of ``discrepancy_length``, the time over which the discrepancy forgets itself."""

    median: Annotated[Spread, Made(partial(read_spread, unit=time_unit, whole="window"))] = Field(
        "10 % of window", validate_default=True
    )
    """A time, or e.g. '10 % of window'."""
    log_std: LogStd = 0.7


class DiscrepancySection(Section):
    """The discrepancy of the model: a Gaussian process beside the errors whose amplitude and length are estimated."""

    amplitude: AmplitudeSection = Field({}, validate_default=True)
    length: LengthSection = Field({}, validate_default=True)
    kernel: Literal["exponential", "matern-3/2", "matern-5/2"] = "exponential"
    """Correlation in time: exponential (rough paths), or Matérn's with one or two derivatives."""
    grows_beyond: Annotated[
        float | None, quantity(lambda c: f"({observable_unit(c)})/({time_unit(c)})", "positive")
    ] = None
    """Rate of the observable beyond which the amplitude grows in proportion to it, e.g. 20 m/s; default: constant."""

    def kernel_at(self, times: Array) -> Kernel:
        """The kernel at observation times (K,)."""
        return Kernel(times, SMOOTHNESS[self.kernel], self.grows_beyond or math.inf)

    def terms(self, parameters: tuple[Parameter, Parameter], maximum: float, window: float) -> tuple[PriorTerm, ...]:
        """Priors of amplitude and length, from the largest observation and the duration of the window."""
        amplitude, length = parameters
        return (
            PriorTerm.lognormal(amplitude, self.amplitude.median.absolute(maximum), self.amplitude.log_std),
            PriorTerm.lognormal(length, self.length.median.absolute(window), self.length.log_std),
        )


def estimated(written: Any) -> Any:
    if written == "estimated":
        return {}
    if written is not None and not isinstance(written, dict):
        raise ValueError("write estimated, or the priors of its amplitude and length")
    return written


HUBER = 1.345  # 95 % efficiency where the errors are Gaussian after all: Huber (1981), Robust Statistics

WITHOUT = "what is missing (NaN) or left out has none"  # of weights and places that are listed
BOUNDS = ("at_most", "at_least")
BESIDE = ("covariance", "correlation_time", "shared", "robust", "discrepancy", "time_std")


def _square(context: Context) -> str:
    unit = observable_unit(context)
    return "1" if unit == "1" else f"({unit})*({unit})"


class CovarianceFile(Section):
    """A CSV file with the full matrix R, without header; its unit (e.g. ``um^2``) is required, never guessed."""

    path: Annotated[str, Field(min_length=1)]
    """CSV file, relative to the configuration's folder; a row per row of the data, in its order, or per one used."""
    unit: Annotated[str, unit_of(_square)]
    """Unit of the covariances, the observable's squared, e.g. um^2."""


class Error(Section):
    """Observation errors: a std or a covariance, of the times, correlation, a robust cost, what the model misses."""

    model_config = ConfigDict(populate_by_name=False)
    std: Annotated[Spread | Column | None, Made(read_error_std, json=QUANTITY_OR_COLUMN)] = Field(
        None, alias=f"{PLACEHOLDER}_std"
    )
    """Std of the observation error: a quantity, e.g. '1 % of maximum', or ``{column: NAME}``, one per reading."""
    time_std: Annotated[float | Spread | Column, Made(read_time_std, json=QUANTITY_OR_COLUMN)] = 0.0
    """Std of the observation times, a quantity, e.g. '5 % of step' (the median time between the readings of a file), or
    ``{column: NAME}``: adds (rate × time_std)²."""
    model_std: Annotated[Spread | None, Made(read_spread)] = None
    """Std of what the model misses from reading to reading, e.g. '1 % of maximum'; its square is added."""
    correlation_time: Annotated[float | None, quantity(time_unit, "positive")] = None
    """Errors are correlated as exp(−|Δt|/τ)."""
    shared: Annotated[
        tuple[Spread | Column, ...], Made(_shared, json={"type": "array", "items": QUANTITY_OR_COLUMN})
    ] = ()
    """Errors that all readings share, independent of each other, each a std for all or ``{column: NAME}`` of a std with
    a sign for each reading: R is the diagonal plus the sum of their products."""
    covariance: Annotated[
        Matrix | None, Made(lambda file, c: Matrix(c.base / expanded(file.path), file.unit, _square(c)), CovarianceFile)
    ] = None
    """File of the whole R."""
    robust: Literal["huber"] | None = None
    """Robust cost: readings far off count less."""
    threshold: Annotated[float, quantity(lambda c: "1", "positive")] = HUBER
    """Threshold of the robust cost in std."""
    at_most: Annotated[bool | Column, MARKS] = False
    """The readings are upper bounds: true, or ``{column: NAME}`` of 1 (bound) and 0; beyond one the std counts."""
    at_least: Annotated[bool | Column, MARKS] = False
    """The same of lower bounds."""
    discrepancy: Annotated[
        DiscrepancySection | None,
        BeforeValidator(estimated, json_schema_input_type=Literal["estimated"] | DiscrepancySection | None),
    ] = None
    """What the model misses: ``estimated``, or priors. Adds ``discrepancy_amplitude`` and ``discrepancy_length``."""

    @classmethod
    def rules(cls, keys: Mapping[str, Any], context: Context, faults: Faults) -> None:
        std, correlated = f"{PLACEHOLDER}_std", ("shared", "correlation_time")
        for name, others, reason in (
            ("covariance", (std, "model_std"), "the file holds the variances"),
            ("covariance", correlated, "the file holds the correlations"),
            ("shared", ("correlation_time",), "give R as a file, covariance: {path: …}"),
            ("robust", (*correlated, "covariance"), "a robust cost needs independent observation errors"),
            *((bound, BESIDE, "bounds need independent errors of known std") for bound in BOUNDS),
        ):
            for other in others if name in keys else ():
                if other in keys:
                    faults.add((name,), f"not together with {other}: {reason}", at_key=True)
        if "threshold" in keys and "robust" not in keys:
            faults.add(("threshold",), "is that of the robust cost; write robust: huber as well", at_key=True)
        if context.observed and not keys.keys() & {std, "covariance"}:
            faults.add((std,), "required: the standard deviation of the observation error")

    def columns(self, readings: str, times: str) -> dict[str, Column]:
        """Columns of errors and of marks of bounds; in the units of ``readings`` and ``times`` where they say none."""
        shared = {f"shared {i}": (part, readings) for i, part in enumerate(self.shared)}
        marks = {key: (marked, "1") for key, marked in self.bounds.items()}
        every = {"std": (self.std, readings), "time_std": (self.time_std, times), **shared, **marks}
        return {key: replace(c, unit=c.unit or unit) for key, (c, unit) in every.items() if isinstance(c, Column)}

    @property
    def bounds(self) -> dict[str, bool | Column]:
        """Which readings are upper and lower bounds."""
        return {BOUNDS[0]: self.at_most, BOUNDS[1]: self.at_least}

    @property
    def separate(self) -> bool:
        """True if the errors of one reading say nothing of those of another, and none is a bound."""
        correlated = self.covariance is not None or self.correlation_time is not None or self.shared
        return not correlated and not any(self.bounds.values())


NUMBERS = TypeAdapter(list[Annotated[float, Field(ge=0, allow_inf_nan=False)]])


class WeightFunction(Section):
    """A function in a file of your own."""

    function: str
    """``./weights.py:name``; it gets times and values (K,) in the model's units, and gives weights (K,)."""


class AwayFromMinima(Section):
    """Zero near the minima of the observations, 1 elsewhere."""

    zero_near_minima: Annotated[float, quantity(time_unit, "positive")]
    """Readings within this time of a local minimum do not count, e.g. 2 us."""


@dataclass(frozen=True)
class Weighing:
    """Weights as they are stated: a ``column`` of the file, or what gives them from times and values (K,). ``stated``
    is what the resolved file says of a user's function, its absolute path; None: what the file says.
    """

    column: Column | None = None
    of: Callable[[Array, Array, float], Array] | None = None
    stated: Any = None

    def weights(self, times: Array, values: Array, prominence: float, read: Array | None) -> Array:
        """β (K,) of the observations of a window; ``read`` (K,) are those of the column. Raises :class:`DataError`
        where they are not as many as the observations, negative or not finite.
        """
        weights = read if read is not None else np.ones(len(times))
        if self.of is not None:
            weights = np.asarray(self.of(times, values, prominence))
        numbers = weights.dtype.kind in "fiub"
        if weights.shape != times.shape or not numbers:
            words = f"{len(weights)} weights" if weights.ndim == 1 and numbers else f"weights {weights.shape}"
            raise DataError(f"{words} for {len(times)} observations of the window; {WITHOUT}")
        weights = weights.astype(float)
        if not (np.all(np.isfinite(weights)) and np.all(weights >= 0)):
            worst = weights[~(np.isfinite(weights) & (weights >= 0))][0]
            raise DataError(f"a weight is {worst:g}; weights must be finite and not negative")
        if not np.any(weights > 0):
            raise DataError("all weights are zero; no observation counts")
        return weights


def weighing(written: Any, context: Context) -> Weighing:
    """Raises ValueError, and :class:`ConfigError` where a function is not to be had."""
    keys = written if isinstance(written, Mapping) else {}
    if isinstance(written, list):
        numbers = np.array(NUMBERS.validate_python(written), dtype=float)
        return Weighing(of=lambda times, values, prominence: numbers)
    if "column" in keys:
        column = OfReadings.model_validate(written, context=context).column
        return Weighing(column=Column(column, "1", "1", kind="weight"))
    if "zero_near_minima" in keys:
        reach = AwayFromMinima.model_validate(written, context=context).zero_near_minima
        return Weighing(of=lambda times, values, prominence: away_from_minima(times, values, reach, prominence))
    if "function" in keys:
        return _of_function(WeightFunction.model_validate(written, context=context).function, context.base)
    raise ValueError("write a list, {column: NAME}, {zero_near_minima: 2 us} or {function: ./weights.py:name}")


def away_from_minima(times: Array, values: Array, reach: float, prominence: float) -> Array:
    """1, but 0 for readings within ``reach`` of a local minimum of ``values`` (K,) at ``times`` (K,).

    >>> away_from_minima(np.arange(5.0), np.array([2.0, 1.0, 0.0, 1.0, 2.0]), 1.0, 0.1)
    array([1., 0., 0., 0., 1.])
    """
    at = times[minima(values, prominence).astype(int)]
    near = np.abs(times[:, None] - at) <= reach * (1 + 1e-9)
    return np.where(near.any(axis=1), 0.0, 1.0)


def _of_function(name: str, base: Path) -> Weighing:
    if not user_file.is_file_reference(name):
        raise ConfigError(f"{shown(name)} is not a function in a file; write ./weights.py:name", "function")
    with retold((ConfigError, PathError, ValueError), ConfigError, "", "function"):
        reference = user_file.absolute(name, base)
        with loading(f"{shown(name)} cannot be loaded"):
            function = user_file.load(reference, f"function {shown(name)}")
    if not callable(function):
        raise ConfigError(f"{shown(name)} is not a function", "function")

    def of(times: Array, values: Array, prominence: float) -> Array:
        try:
            return np.asarray(function(times.copy(), values.copy()))
        except BaseException as error:
            raise DataError(f"{name}: {reason_of(error)}") from None

    return Weighing(of=of, stated={"function": reference})


SECTIONS = OfReadings, AwayFromMinima, WeightFunction
WEIGHTS = Made(weighing, json={"oneOf": [NUMBERS.json_schema(), *(kind.model_json_schema() for kind in SECTIONS)]})


@dataclass(frozen=True)
class Placing:
    """Places as they are stated: a ``column``, or ``positions`` (one for all readings, or one each). ``of``: the field
    with coordinates that they are on; None: they are indices of its components.
    """

    column: Column | None = None
    positions: Array | None = None
    of: StateBlock | None = None
    size: int | None = None

    def places(self, count: int, read: Array | None) -> Places:
        """Places of ``count`` observations; ``read`` (count,) is what the column holds. Raises :class:`DataError`."""
        stated = read if self.positions is None else self.positions
        assert stated is not None
        if len(stated) not in (1, count):
            raise DataError(f"{len(stated)} places for {count} observations of the window; {WITHOUT}")
        positions = np.broadcast_to(stated, (count,))
        if self.of is not None and self.of.coordinates is not None:
            return Places.at_coordinates(positions, self.of.coordinates, self.of.coordinate_unit)
        wrong = positions[(positions != np.round(positions)) | (positions < 0) | (positions >= (self.size or np.inf))]
        if len(wrong):
            last = f" to {self.size - 1}" if self.size else ""
            raise DataError(f"{wrong[0]:g} is not the index of a component of the field; they go from 0{last}")
        return Places.at_indices(positions.astype(int))


def placing(written: Any, context: Context) -> Placing:
    """Raises :class:`ConfigError`, its path the faulty key, ValueError."""
    section, entries = None, written if isinstance(written, list) else [written]
    if isinstance(written, Mapping) and "column" in written:
        section = InUnit.model_validate(written, context=context)
    elif not all(isinstance(entry, int | str) and not isinstance(entry, bool) for entry in entries):
        raise ValueError("write an index, a coordinate such as '3 m', a list of either, or {column: NAME}")
    block = field_of(context.units, context.observable)
    size = block.size if block else None
    if section is not None:
        if section.unit is None:
            return Placing(Column(section.column, "1", "1", kind="place"), size=size)
        target = _coordinates(block, "unit")
        with retold(UnitError, ConfigError, "", "unit"):
            convert(1.0, section.unit, target.coordinate_unit)
        return Placing(Column(section.column, section.unit, target.coordinate_unit, kind="place"), of=target)
    if all(isinstance(entry, int) for entry in entries):
        return Placing(positions=np.array(entries, dtype=float), size=size)
    target = _coordinates(block, "")
    return Placing(positions=np.array([parse_quantity(e, target.coordinate_unit) for e in entries]), of=target)


def _coordinates(block: StateBlock | None, key: str) -> StateBlock:
    if block is None or block.coordinates is None:
        why = "the model gives no coordinates for what is observed"
    elif np.ndim(block.coordinates) > 1:
        why = f"{block.name} has several coordinates a place"
    else:
        return block
    raise ConfigError(f"{why}; write indices, counted from 0, without a unit", key)


STATED = TypeAdapter[Any](int | str | list[int | str])
PLACES = Made(placing, json={"oneOf": [STATED.json_schema(), InUnit.model_json_schema()]})
