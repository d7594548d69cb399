"""A tree of datasets → the bytes of a NETCDF4 file, three times faster than through xarray's file backend.

All definitions come before all data: HDF5 then lays out its metadata once. The encoding is xarray's own (NaN as fill
value of floats, truth values as bytes with ``dtype: bool``, text as variable-length strings), so that every reader
sees the same. Everything happens in memory: a worker far away can do it, and a file system is touched once.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from typing import Any

import netCDF4
import numpy as np
import xarray as xr

from en4dvar.seal import sealed

_LOCK = threading.Lock()  # the netCDF library is not safe to use from several threads
_INITIAL_SIZE = 1 << 19  # bytes; grows as needed


def to_bytes(tree: xr.DataTree) -> bytes:
    """The file of a tree whose variables are floats, integers, truth values or text; its last line seals it."""
    with _LOCK:
        file = netCDF4.Dataset("in-memory.nc", "w", format="NETCDF4", memory=_INITIAL_SIZE)
        try:
            data = [item for node in tree.subtree for item in _define(file, node)]
            for variable, values in data:
                variable[...] = values if values.ndim else values[()]
        except BaseException:
            file.close()
            raise
        return sealed(bytes(file.close()))


def _define(file: netCDF4.Dataset, node: xr.DataTree) -> Iterator[tuple[Any, Any]]:
    """Define a group; yields its variables with the values to be written."""
    dataset = node.to_dataset(inherit=False)
    group = file if node.path == "/" else file.createGroup(node.path)
    group.setncatts({str(key): value for key, value in dataset.attrs.items()})
    for name, size in dataset.sizes.items():
        group.createDimension(str(name), size)
    scattered = {str(name): set(c.dims) for name, c in dataset.coords.items() if name not in dataset.dims}
    unused = set(scattered)
    for name, variable in dataset.variables.items():
        values = variable.values
        attributes = {str(key): value for key, value in variable.attrs.items()}
        along = {c for c, dims in scattered.items() if dims <= set(variable.dims) and name not in dataset.coords}
        unused -= along
        if along:
            attributes["coordinates"] = " ".join(sorted(along))
        if values.dtype == bool:
            values, attributes["dtype"] = values.astype(np.int8), "bool"
        kind = str if values.dtype.kind in "OU" else values.dtype
        missing = values.dtype.kind == "f" and "_FillValue" not in variable.encoding and name not in dataset.coords
        dims = tuple(map(str, variable.dims))
        target = group.createVariable(str(name), kind, dims, fill_value=np.nan if missing else None)
        target.set_auto_maskandscale(False)
        target.setncatts(attributes)
        yield target, values.astype(object) if kind is str else values
    if unused:
        group.setncattr("coordinates", " ".join(sorted(unused)))
