"""What is said of each reading beside its error: its weight (``data.weights``) and its place (``data.places``)."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field, TypeAdapter

from en4dvar.config.context import Context, Made, quantity, time_unit
from en4dvar.config.schema import OfReadings, Section
from en4dvar.data.series import Places
from en4dvar.inputs.asked import Column
from en4dvar.inputs.window import minima
from en4dvar.model.forward import field_of
from en4dvar.model.state import Array
from en4dvar.model.state import Field as StateBlock
from en4dvar.plumbing import user_file
from en4dvar.plumbing.errors import ConfigError, DataError, retold
from en4dvar.plumbing.files import PathError
from en4dvar.plumbing.hints import shown
from en4dvar.plumbing.units import UnitError, convert, parse_quantity
from en4dvar.plumbing.user_code import loading, reason_of

NUMBERS = TypeAdapter(list[Annotated[float, Field(ge=0, allow_inf_nan=False)]])


class WeightColumn(OfReadings):
    """A column of weights, one per reading; the numbers have no unit."""


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
    """Weights as they are stated: a ``column`` of the file, or what gives them from times and values (K,).

    ``stated`` is what the resolved file says of a user's function, its absolute path; None: what the file says.
    """

    column: Column | None = None
    of: Callable[[Array, Array, float], Array] | None = None
    stated: Any = None

    def weights(self, times: Array, values: Array, prominence: float, read: Array | None) -> Array:
        """β (K,) of the observations of a window; ``read`` (K,) are those of the column.

        Raises :class:`DataError` where they are not as many as the observations, negative or not finite.
        """
        weights = read if read is not None else np.ones(len(times))
        if self.of is not None:
            weights = np.asarray(self.of(times, values, prominence))
        numbers = weights.dtype.kind in "fiub"
        if weights.shape != times.shape or not numbers:
            words = f"{len(weights)} weights" if weights.ndim == 1 and numbers else f"weights {weights.shape}"
            raise DataError(f"{words} for {len(times)} observations of the window")
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
        column = WeightColumn.model_validate(written, context=context).column
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


SECTIONS = WeightColumn, AwayFromMinima, WeightFunction
WEIGHTS = Made(weighing, json={"oneOf": [NUMBERS.json_schema(), *(kind.model_json_schema() for kind in SECTIONS)]})


class PlaceColumn(OfReadings):
    """A column of places, one per reading."""

    unit: str | None = None
    """Unit of the coordinates in it; without a unit they are indices, counted from 0."""


@dataclass(frozen=True)
class Placing:
    """Places as they are stated: a ``column``, or ``positions`` (one for all readings, or one each).

    ``of``: the field with coordinates that they are on; None: they are indices of its components.
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
            raise DataError(f"{len(stated)} places for {count} observations of the window")
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
        section = PlaceColumn.model_validate(written, context=context)
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
        message = "the model gives no coordinates for what is observed; write indices, counted from 0, without a unit"
        raise ConfigError(message, key)
    if np.ndim(block.coordinates) > 1:
        message = f"{block.name} has several coordinates a place; write indices, counted from 0, without a unit"
        raise ConfigError(message, key)
    return block


STATED = TypeAdapter[Any](int | str | list[int | str])
PLACES = Made(placing, json={"oneOf": [STATED.json_schema(), PlaceColumn.model_json_schema()]})
