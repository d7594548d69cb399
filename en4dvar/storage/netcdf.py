"""Groups of variables → the bytes of a NETCDF4 file, several times faster than through xarray's file backend.

All definitions come before all data: HDF5 then lays out its metadata once. The encoding is xarray's own (NaN as fill
value of floats, truth values as bytes with ``dtype: bool``, text as variable-length strings), so that every reader
sees the same. Everything happens in memory: a worker far away can do it, and a file system is touched once.

:class:`Group` and :class:`Variable` are what a worker makes; :func:`tree_of` shows them through xarray.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import netCDF4
import numpy as np

from en4dvar.errors import OutputError
from en4dvar.files import atomic_path
from en4dvar.storage.seal import SealedBytes, check_seal, seal_file

if TYPE_CHECKING:
    import xarray as xr

_LOCK = threading.Lock()  # the netCDF library is not safe to use from several threads
_MORE = 1 << 18  # bytes; more than the library had left to write
_INITIAL_SIZE = 1 << 19  # bytes beside those of large variables; grows as needed
_LARGE = 1 << 24  # bytes of a variable


@dataclass(frozen=True)
class Variable:
    """Values along named dimensions: floats, integers, truth values or text. ``fill``: NaN means a missing value.

    ``single``: floats are stored in single precision.
    """

    dims: tuple[str, ...]
    values: np.ndarray[Any, Any]
    attrs: Mapping[str, Any]
    fill: bool = True
    single: bool = False


@dataclass(frozen=True)
class Group:
    """Variables, and coordinates of its dimensions, by name."""

    variables: Mapping[str, Variable] = field(default_factory=dict)
    coords: Mapping[str, Variable] = field(default_factory=dict)
    attrs: Mapping[str, Any] = field(default_factory=dict)

    @property
    def every(self) -> dict[str, Variable]:
        """Variables and coordinates."""
        return {**self.variables, **self.coords}

    @property
    def sizes(self) -> dict[str, int]:
        """Length of every dimension."""
        return {dim: size for v in self.every.values() for dim, size in zip(v.dims, v.values.shape, strict=True)}

    def check_sizes(self) -> None:
        """Raise :class:`ValueError` where variables do not agree on the length of a dimension, as xarray does."""
        sizes = self.sizes
        for name, v in self.every.items():
            if v.values.shape != tuple(sizes[dim] for dim in v.dims):
                raise ValueError(f"{name} has the shape {v.values.shape}, its dimensions have other sizes")


def netcdf_attributes(attributes: Mapping[Any, Any]) -> dict[str, Any]:
    """Attributes as netCDF can hold them: truth values become 0/1, absent ones "", other objects their text."""

    def plain(value: Any) -> Any:
        if isinstance(value, bool | np.bool_):
            return int(value)
        if value is None:
            return ""
        return value if isinstance(value, str | int | float | np.number | np.ndarray) else str(value)

    return {str(key): plain(value) for key, value in attributes.items()}


def variable(
    dims: str | tuple[str, ...],
    values: Any,
    units: str,
    long_name: str,
    *,
    fill: bool = True,
    single: bool = False,
    **attrs: Any,
) -> Variable:
    """A variable with what CF asks of it."""
    dims = (dims,) if isinstance(dims, str) else dims
    attributes = netcdf_attributes({"units": units, "long_name": long_name, **attrs})
    return Variable(dims, np.asarray(values), attributes, fill, single)


Groups = Mapping[str, Group]
"""By path, the root ``/`` first."""


def tree_of(groups: Groups) -> xr.DataTree:
    """The groups as xarray shows them."""
    import xarray as xr

    return xr.DataTree.from_dict(datasets_of(groups))


def datasets_of(groups: Groups) -> dict[str, xr.Dataset]:
    """Each group as xarray shows it, by path."""
    import xarray as xr

    def shown(v: Variable) -> xr.Variable:
        values = v.values.astype(np.float32) if v.single else v.values
        return xr.Variable(v.dims, values, v.attrs, {} if v.fill else {"_FillValue": None})

    def dataset(group: Group) -> xr.Dataset:
        variables, coords = ({n: shown(v) for n, v in part.items()} for part in (group.variables, group.coords))
        return xr.Dataset(variables, coords, group.attrs)

    return {path: dataset(group) for path, group in groups.items()}


def groups_of(nodes: Mapping[str, xr.Dataset]) -> dict[str, Group]:
    """What xarray shows, by path, as groups again; how it is encoded is left out."""

    def variables(held: Mapping[Any, xr.DataArray]) -> dict[str, Variable]:
        return {
            str(name): Variable(tuple(map(str, v.dims)), v.values, netcdf_attributes(v.attrs))
            for name, v in held.items()
        }

    return {
        path: Group(variables(node.data_vars), variables(node.coords), netcdf_attributes(node.attrs))
        for path, node in nodes.items()
    }


def to_bytes(groups: Groups) -> SealedBytes:
    """The file of the groups; its last line seals it."""
    sizes = [v.values.nbytes // (1 + v.single) for group in groups.values() for v in group.variables.values()]
    memory = _INITIAL_SIZE + sum(size for size in sizes if size > _LARGE)  # growing takes it twice
    with _LOCK:
        file = netCDF4.Dataset("in-memory.nc", "w", format="NETCDF4", memory=memory)
        try:
            data = [item for path, group in groups.items() for item in _define(file, path, group)]
            for variable, values in data:
                _write(variable, values)
        except BaseException:
            file.close()
            raise
        content = file.close()
    return SealedBytes.of(content)


def _write(variable: Any, values: np.ndarray[Any, Any]) -> None:
    """A block of rows at a time: what the library has to convert is never there twice."""
    if values.nbytes <= _LARGE:
        variable[...] = values if values.ndim else values[()]
        return
    rows = max(1, _LARGE * len(values) // values.nbytes)
    for first in range(0, len(values), rows):
        variable[first : first + rows] = values[first : first + rows]


def read_groups(path: Path) -> dict[str, xr.Dataset]:
    """The groups of a sealed file by their paths, in memory; the file can be replaced while they are in use.

    Raises
    ------
    OutputError: it is none of ours, cut short or altered (see :mod:`en4dvar.storage.seal`).
    """
    import xarray as xr

    check_seal(path)
    try:
        with xr.open_datatree(path, engine="netcdf4", decode_timedelta=False) as tree:
            return {node.path: node.to_dataset(inherit=False).load() for node in tree.subtree}
    except OSError as error:
        raise OutputError(f"{path}: not a readable netCDF file: {error.strerror or error}") from None


@contextmanager
def netcdf_file(path: Path) -> Iterator[Path]:
    """A partial file to be written through the netCDF library; on leaving it is sealed and takes its place.

    Raises :class:`OutputError` as :func:`~en4dvar.files.atomic_path`.
    """
    with atomic_path(path) as partial:
        try:
            yield partial
        except (RuntimeError, OSError) as error:  # of the operating system's reason the library tells "HDF error"
            _write_more(partial)
            raise OutputError(f"{path}: cannot be written: {error}") from None
        seal_file(partial)


def _write_more(partial: Path) -> None:
    """Fail as the library did, with the operating system's reason: disk or quota full, a device that is broken."""
    with partial.open("ab") as file:
        file.write(bytes(_MORE))
        file.flush()
        os.fsync(file.fileno())


def attributes_of(variable: Variable) -> dict[str, Any]:
    """With what tells that a variable holds truth values, which netCDF knows as bytes."""
    return {**variable.attrs, **({"dtype": "bool"} if variable.values.dtype == bool else {})}


def _define(file: netCDF4.Dataset, path: str, content: Group) -> Iterator[tuple[Any, Any]]:
    """Define a group; yields its variables with the values to be written."""
    group = file if path == "/" else file.createGroup(path)
    group.setncatts(dict(content.attrs))
    for name, size in content.sizes.items():
        group.createDimension(name, size)
    for name, variable in (*content.variables.items(), *content.coords.items()):
        values, attributes = variable.values, attributes_of(variable)
        if values.dtype == bool:
            values = values.astype(np.int8)
        kind = str if values.dtype.kind in "OU" else np.dtype(np.float32) if variable.single else values.dtype
        missing = values.dtype.kind == "f" and variable.fill and name in content.variables
        target = group.createVariable(name, kind, variable.dims, fill_value=np.nan if missing else None)
        target.set_auto_maskandscale(False)
        target.setncatts(attributes)
        yield target, values.astype(object) if kind is str else values
