"""``data.places``: where on a field the readings were taken, by index or by coordinate."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from pydantic import Field, TypeAdapter

from en4dvar.config.context import Context, Made
from en4dvar.config.schema import Section
from en4dvar.data.series import Places
from en4dvar.inputs.asked import Column
from en4dvar.model.forward import field_of
from en4dvar.model.state import Array
from en4dvar.model.state import Field as StateBlock
from en4dvar.plumbing.errors import ConfigError, DataError, retold
from en4dvar.plumbing.units import UnitError, convert, parse_quantity


class PlaceColumn(Section):
    """A column of places, one per reading."""

    column: Annotated[str, Field(min_length=1)]
    """Header of the column (CSV) or name of the field (.mat)."""
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
