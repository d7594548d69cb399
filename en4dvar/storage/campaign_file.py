"""``posterior.nc`` of a campaign: the files of its data sets side by side along the dimension ``dataset``.

It is written by streaming: one data set is in memory at a time. Dimensions follow the files of the data sets, in the
ArviZ schema, with ``dataset`` in front; ``time`` becomes ``observation`` (padded with NaN to the longest data set) and
the observation times a variable. Scalars that judge a fit become variables of ``sample_stats``. The paths between the
observations, the iterations, the descents and the modes stay in ``datasets/``.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import netCDF4
import numpy as np

from en4dvar.errors import OutputError
from en4dvar.storage.netcdf import netcdf_file
from en4dvar.storage.seal import check_seal

GROUPS = (
    "prior", "posterior", "prior_predictive", "posterior_predictive", "observed_data", "observation_errors",
    "constant_data", "sample_stats", "log_likelihood",
)  # fmt: skip
LEFT_OUT = {"path_time", "iteration", "mode", "descent"}
RENAMED = {"time": "observation", "time_column": "observation_column"}  # padded to the longest data set
PARAMETER = "parameter"
FAILURES = "failed_datasets"  # root attribute: JSON of name → reason


def save_campaign(
    path: Path,
    sources: Mapping[str, Path],
    n_observations: int,
    attributes: Mapping[str, Any],
    failures: Mapping[str, str],
) -> Path:
    """Write the campaign's file.

    Parameters
    ----------
    sources: name of the data set → its file, in order; not empty.
    n_observations: of the longest data set.
    attributes: of the root. failures: name of the data set without a posterior → reason.

    Raises
    ------
    OutputError: the file cannot be written.
    """
    with netcdf_file(path) as partial:
        _write(partial, sources, n_observations, {**attributes, FAILURES: json.dumps(failures, ensure_ascii=False)})
    return path


def _write(path: Path, sources: Mapping[str, Path], n_observations: int, attributes: Mapping[str, Any]) -> None:
    with netCDF4.Dataset(path, "w", format="NETCDF4") as target:
        target.setncatts(attributes)
        with netCDF4.Dataset(max(sources.values(), key=_parameters)) as widest:
            widest.set_auto_maskandscale(False)
            _define(target, widest, _scalars(sources.values()), len(sources), n_observations)
        for i, (name, file) in enumerate(sources.items()):
            with netCDF4.Dataset(file) as source:
                source.set_auto_maskandscale(False)
                for group in GROUPS:
                    target[group]["dataset"][i] = name
                    _copy(target[group], source[group], i)


def _parameters(file: Path) -> int:
    """How many a data set has: one that varies in time has the more changes the longer the window."""
    with netCDF4.Dataset(file) as source:
        return len(source["sample_stats"].dimensions[PARAMETER])


def _scalars(files: Iterable[Path]) -> dict[str, dict[str, Any]]:
    """Group → name → type of every scalar that any data set has: one that was sampled has more than its neighbour."""
    found: dict[str, dict[str, Any]] = {group: {} for group in GROUPS}
    for file in files:
        with netCDF4.Dataset(file) as source:
            for group, kinds in found.items():
                for key in source[group].ncattrs():
                    text = isinstance(source[group].getncattr(key), str)
                    kinds.setdefault(key, str if text else np.dtype(float))
    return found


def failed_datasets(path: Path) -> dict[str, str]:
    """Name of the data set without a posterior → reason, from a campaign's file; empty where there is no such file."""
    if not path.is_file():
        return {}
    check_seal(path)
    try:
        with netCDF4.Dataset(path) as file:
            return {str(k): str(v) for k, v in json.loads(getattr(file, FAILURES, "{}")).items()}
    except OSError as error:
        raise OutputError(f"{path}: not a readable netCDF file: {error.strerror or error}") from None


def _define(
    target: netCDF4.Dataset,
    widest: netCDF4.Dataset,
    scalars: Mapping[str, Mapping[str, Any]],
    n_datasets: int,
    n_observations: int,
) -> None:
    """Groups, dimensions, variables and coordinates, as in the file of the (first) data set with most parameters, and
    the ``scalars`` of all.
    """
    for name in GROUPS:
        source, group = widest[name], target.createGroup(name)
        group.createDimension("dataset", n_datasets)
        kept = [v for v in source.variables.values() if not LEFT_OUT & {*v.dimensions, v.name}]
        for dim in sorted({dim for variable in kept for dim in variable.dimensions}):
            size = n_observations if dim in RENAMED else len(source.dimensions[dim])
            group.createDimension(RENAMED.get(dim, dim), size)
        _create(group, "dataset", str, ("dataset",), {"units": "1", "long_name": "data set"})
        for variable in kept:
            own = variable.name not in variable.dimensions or variable.name == "time"  # of each data set
            dims = tuple(RENAMED.get(dim, dim) for dim in variable.dimensions)
            attributes = {k: variable.getncattr(k) for k in variable.ncattrs() if k != "_FillValue"}
            made = _create(group, variable.name, variable.dtype, ("dataset", *dims) if own else dims, attributes, own)
            if not own:
                made[...] = variable[...]
        for key, kind in scalars[name].items():
            variable_name = f"{key}_total" if key in group.variables else key  # a parameter's share keeps its name
            about = {"units": "1", "long_name": key.replace("_", " "), "attribute": key}
            _create(group, variable_name, kind, ("dataset",), about, padded=True)


def _create(
    group: netCDF4.Group,
    name: str,
    kind: Any,
    dims: tuple[str, ...],
    attributes: Mapping[str, Any],
    padded: bool = False,
) -> netCDF4.Variable:
    """A variable; where it is ``padded``, floats that are missing are NaN."""
    fill = np.nan if padded and kind is not str and kind.kind == "f" else None
    made = group.createVariable(name, kind, dims, fill_value=fill)
    made.setncatts(attributes)
    made.set_auto_maskandscale(False)
    return made


def _copy(group: netCDF4.Group, source: netCDF4.Group, i: int) -> None:
    """The values of data set ``i``; what it lacks stays missing."""
    places = _places(group, source)
    for variable in group.variables.values():
        if variable.dimensions[:1] != ("dataset",) or variable.name == "dataset":
            continue
        if "attribute" in variable.ncattrs():
            key = variable.getncattr("attribute")
            if key in source.ncattrs():
                variable[i] = source.getncattr(key)
        elif variable.name in source.variables and (given := source[variable.name]).size:  # no parameter, no value
            where = (
                places if dim == PARAMETER else slice(n) for dim, n in zip(given.dimensions, given.shape, strict=True)
            )
            variable[(i, *where)] = given[...]


def _places(group: netCDF4.Group, source: netCDF4.Group) -> slice | list[int]:
    """Where the parameters of a data set stand among those of the campaign."""
    if PARAMETER not in source.variables:
        return slice(None)
    names = group[PARAMETER][...].tolist()
    return [names.index(name) for name in source[PARAMETER][...].tolist()]
