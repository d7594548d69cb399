"""Readings that a script holds in memory: arrays, a pandas or an xarray object, as columns with names.

pandas and xarray objects are known by what they can do, so that neither need be installed.
"""

import csv
import io
import math
from collections.abc import Mapping, Sequence
from itertools import zip_longest
from typing import Any

import numpy as np

from en4dvar.model.state import Array, floats
from en4dvar.plumbing.errors import DataError
from en4dvar.plumbing.hints import listed, shown, suggest

TIME = "time"
VALUE = "y"
FORMS = "(times, values), a dict of columns, a pandas Series or DataFrame, or an xarray DataArray or Dataset"


def columns_of(data: Any, time: str = TIME, value: str = VALUE) -> dict[str, Array]:
    """Columns by name, that of the times first and called :data:`TIME`, all of one length; NaN is missing, or masked.

    ``data``: one of :data:`FORMS`; ``time``: name of the column, coordinate or index of times; ``value``: what a series
    without a name is called.
    Raises :class:`DataError`: it is none of these, has no times, or columns differ in length or are no numbers.
    """
    columns = _columns(data, time, value)
    times = columns.pop(time, None)
    if times is None:
        raise DataError(f"no column {time!r} of times{suggest(time, columns)}; say which it is: time='...'")
    numbers = {name: _numbers(name, column) for name, column in {TIME: times, **columns}.items()}
    if missing := np.flatnonzero(np.isnan(numbers[TIME])).tolist():
        raise DataError(
            f"the time of reading {missing[0] + 1} is NaN or masked; leave out the reading, or set its value to NaN"
        )
    for name, column in numbers.items():
        if column.shape != numbers[TIME].shape:
            raise DataError(f"{name!r} has shape {column.shape}, but there are {len(numbers[TIME])} times")
    return numbers


def _columns(data: Any, time: str, value: str) -> dict[str, Any]:
    if isinstance(data, Mapping) and not hasattr(data, "data_vars"):
        return {str(name): column for name, column in data.items()}
    if hasattr(data, "data_vars"):  # xarray.Dataset
        return {**_coordinate(data, time), **{str(name): data[name].values for name in data.data_vars}}
    if hasattr(data, "dims") and hasattr(data, "coords"):  # xarray.DataArray
        return {**_coordinate(data, time), str(data.name or value): data.values}
    if hasattr(data, "columns") and hasattr(data, "index"):  # pandas.DataFrame
        columns = {str(name): data[name] for name in data.columns}
        return columns if time in columns else {time: data.index, **columns}
    if hasattr(data, "index") and hasattr(data, "to_numpy"):  # pandas.Series
        return {time: data.index, str(data.name or value): data}
    if isinstance(data, Sequence) and not isinstance(data, str) and len(data) == 2:
        return {time: data[0], value: data[1]}
    raise DataError(f"{type(data).__name__} is none of: {FORMS}")


def _coordinate(data: Any, time: str) -> dict[str, Any]:
    """The times of an xarray object: the coordinate of that name, else the one of its only dimension."""
    names = [time, *map(str, data.dims)] if len(data.dims) == 1 else [time]
    return next(({time: data.coords[name].values} for name in names if name in data.coords), {})


def _numbers(name: str, column: Any) -> Array:
    values = np.asanyarray(column)
    if values.dtype.kind in "Mm":
        seconds = "(t - t[0]) / np.timedelta64(1, 's')"
        raise DataError(f"{name!r} holds dates; give elapsed time as numbers, e.g. {seconds} for seconds")
    try:
        numbers = floats(values)
    except (TypeError, ValueError):
        first = shown(values.ravel().tolist()[0]) if values.size else "nothing"
        raise DataError(f"{name!r} holds no numbers but {first}") from None
    if numbers.ndim != 1:
        raise DataError(f"{name!r} has shape {numbers.shape}; give one number a time, shape (K,)")
    return numbers


def tables_of(data: Any, time: str = TIME, names: Sequence[str] | None = None) -> dict[str, Any] | None:
    """The readings of each series by its name, where ``data`` holds several of them; else None.

    Several are a dict of series, each in one of :data:`FORMS` (a dict with a column of times is one table), or the
    columns ``names`` of one table. Raises :class:`DataError`: it has no such column.
    """
    if names is not None:
        columns = columns_of(data, time)
        require_columns(columns, names)
        beside = {name: column for name, column in columns.items() if name not in names}
        times = beside.pop(TIME)
        return {name: {time: times, name: columns[name], **beside} for name in names}
    plain = isinstance(data, Mapping) and not hasattr(data, "data_vars")
    if plain and data and time not in data and all(map(_is_table, data.values())):
        return {str(name): table for name, table in data.items()}
    return None


def _is_table(data: Any) -> bool:
    """Whether it is in one of :data:`FORMS`, not the numbers of a column."""
    if isinstance(data, Sequence):
        return len(data) == 2 and not isinstance(data, str) and all(np.ndim(part) for part in data)
    return isinstance(data, Mapping) or hasattr(data, "dims") or hasattr(data, "index")


def csv_of(columns: Mapping[str, Array]) -> str:
    """The columns as a CSV file that reads back to the bit; shorter ones end in NaN."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows([repr(float(x)) for x in row] for row in zip_longest(*columns.values(), fillvalue=math.nan))
    return text.getvalue()


def require_columns(columns: Mapping[str, Array], names: Sequence[str]) -> None:
    """Raise :class:`DataError` for one that is not there."""
    for name in names:
        if name not in columns:
            raise DataError(f"no column {name!r}; the columns are: {listed(columns)}")
