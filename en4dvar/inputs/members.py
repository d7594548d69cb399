"""What files hold besides readings: ensembles of parameters, and square tables (covariances, correlations).

Ensembles are a posterior of ours, netCDF of others, CSV. Values are read, and nothing else.
"""

import csv
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from en4dvar.inputs.parts import Layout, Matrix, opened, read_contents, readable
from en4dvar.inputs.text_table import cells_of, delimiter_of, number_in, numbered_lines
from en4dvar.model.state import Array, floats
from en4dvar.plumbing.decoding import Allowed, decoded_whole, require_whole
from en4dvar.plumbing.errors import DataError, retold
from en4dvar.plumbing.hints import listed, suggest
from en4dvar.plumbing.tables import is_number, unescaped
from en4dvar.plumbing.units import UnitError, convert


def read_covariance(matrix: Matrix) -> Array:
    """The covariance (K, K) of a CSV file: symmetric, positive variances. Raises :class:`DataError`."""
    path, values = matrix.path, read_square(matrix.path, "covariance")
    if not np.all(np.isfinite(values)) or not np.all(np.diag(values) > 0):
        raise DataError(f"{path}: the variances must be positive and every covariance finite")
    scale = np.sqrt(np.outer(np.diag(values), np.diag(values)))
    unequal = np.argwhere(np.abs(values - values.T) > 1e-9 * scale)
    if len(unequal):
        i, j = unequal[0]
        place = f"row {i + 1}, column {j + 1}"
        raise DataError(f"{path}: not symmetric: {values[i, j]:g} in {place}, {values[j, i]:g} across")
    return np.asarray(convert(0.5 * (values + values.T), matrix.unit, matrix.target))


def read_square(path: Path, what: str = "correlation matrix") -> Array:
    """The numbers (K, K) of a CSV file without header. Raises :class:`DataError`."""
    rows: list[list[float]] = []
    delimiter = None
    with opened(path, Layout("csv")):
        for number, line in numbered_lines(path):
            delimiter = delimiter_of(line, path) if delimiter is None else delimiter
            cells = enumerate(cells_of(line, delimiter), 1)
            rows.append([number_in(cell, str(i), path, number, None) for i, cell in cells])
            if len(rows[-1]) != len(rows[0]):
                raise DataError(f"{path}:{number}: {len(rows[-1])} numbers, but {len(rows[0])} in the first row")
    if not rows or len(rows) != len(rows[0]):
        raise DataError(f"{path}: a {what} is square, but this has {len(rows)} rows of {len(rows[0]) if rows else 0}")
    return np.array(rows)


NETCDF = (".nc", ".nc4", ".cdf")
DRAWS = ("chain", "draw", "member", "sample", "realization", "ensemble")  # dimensions along which members lie
MOST_MEMBERS = 1_000_000
LARGEST = 256_000_000_000  # bytes of a file


def read_members(path: Path, units: Mapping[str, tuple[str, str]]) -> dict[str, Array]:
    """Members (N,) of each parameter by name, in its own unit.

    ``units``: for each name the unit that is wanted and, "" where the file tells it, the one in the file.
    Raises :class:`DataError`: the file cannot be read, lacks a name or a unit, or holds numbers that are not finite.
    """
    if path.suffix.lower() in NETCDF:
        allowed = Allowed(60, 4_000_000_000, LARGEST)
        columns = decoded_whole(netcdf_members, path, list(units), allowed=allowed, kind="netCDF")
    else:
        columns = _of_table(path, units)
    lengths = {name: len(values) for name, (values, _) in columns.items()}
    if len(set(lengths.values())) != 1:
        raise DataError(f"{path}: unequal numbers of members: {listed([f'{k} {n}' for k, n in lengths.items()])}")
    members = {}
    for name, (values, unit) in columns.items():
        if count := int(np.sum(~np.isfinite(values))):
            raise DataError(f"{path}: {name} has {count} members that are not finite numbers")
        members[name] = _converted(path, name, values, unit, units[name])
    return members


def read_centres(path: Path, units: Mapping[str, str]) -> dict[str, dict[str, float]]:
    """Of a ``summary.csv`` of a run, data set → parameter → centre, in ``units``; nothing of another file. Raises
    :class:`DataError`: no data set has any of the parameters, or a number is none.
    """
    if path.suffix.lower() != ".csv":
        return {}
    with readable(path):
        rows = csv.DictReader(line for _, line in numbered_lines(path))
    if not {"dataset", "name", "unit", "centre"} <= {*(rows.fieldnames or ())}:
        return {}
    sets: dict[str, dict[str, float]] = {}
    for row in rows:
        if (name := row["name"]) in units:
            centre = np.array([float(row["centre"] if is_number(row["centre"]) else "nan")])
            if not np.isfinite(centre).all():
                raise DataError(f"{path}: the centre of {name} of {row['dataset']} is no finite number")
            own = _converted(path, name, centre, row["unit"], (units[name], ""))
            sets.setdefault(unescaped(row["dataset"]), {})[name] = own.item()
    if not sets:
        raise DataError(f"{path}: no data set has {listed(units)}")
    return sets


def _converted(path: Path, name: str, values: Array, unit: str, units: tuple[str, str]) -> Array:
    target, stated = units
    unit = stated or unit
    if not unit and target != "1":
        hint = f"netCDF has it as attribute units; a prior may say it, '{name}: {{prior: ensemble, unit: {target}}}'"
        raise DataError(f"{path}: {name} has no unit there; {hint}")
    with retold(UnitError, DataError, f"{path}: {name}: "):
        return np.asarray(convert(values, unit or "1", target), dtype=float)


def _of_table(path: Path, names: Mapping[str, Any]) -> dict[str, tuple[Array, str]]:
    contents = read_contents(path)
    for name in names:
        if name not in contents.columns:
            raise DataError(contents.others.get(name) or f"{path}: no column {name!r}{suggest(name, contents.columns)}")
    return {name: (contents.columns[name], "") for name in names}


def netcdf_members(path: Path, names: Sequence[str]) -> Iterator[dict[str, tuple[Array, str]]]:
    """The numbers of each name, with their unit; of a population those of its next data set, ``G_next``. Raises
    :class:`DataError`.
    """
    import netCDF4  # a tenth of a second that other files do not need

    require_whole(path)
    with netCDF4.Dataset(path) as file:
        group = file.groups.get("posterior", file)
        stats = file.groups.get("sample_stats") if group is not file else None
        alive = None
        if stats is not None and "active" in stats.variables:
            alive = _numbers(path, stats.variables["active"]) > 0
        members = {}
        for name in names:
            if name not in group.variables:
                raise DataError(f"{path}: no variable {name!r}{suggest(name, group.variables)}")
            following = group.variables.get(f"{name}_next") if "without_hyperprior" in file.groups else None
            variable = group.variables[name] if following is None else following
            values = _numbers(path, variable)
            values = values[alive] if alive is not None and len(alive) == len(values) else values
            members[name] = values, str(getattr(variable, "units", ""))
        yield members


def _numbers(path: Path, variable: Any) -> Array:
    """All numbers of a variable along its members, NaN where they are missing; those that data sets share once."""
    others = [d for d, size in zip(variable.dimensions, variable.shape, strict=True) if d not in DRAWS and size != 1]
    if others == ["dataset"] and variable.size <= MOST_MEMBERS:
        each = np.ma.filled(np.ma.asarray(variable[:]).astype(float), np.nan)
        each = np.moveaxis(each, variable.dimensions.index("dataset"), 0)
        if np.array_equal(each, np.broadcast_to(each[0], each.shape)):
            return np.asarray(each[0].ravel())
    if others or not variable.ndim:
        where = f"lies along {', '.join(variable.dimensions) or 'nothing'}"
        raise DataError(f"{path}: {variable.name} {where}; members must lie along one of {', '.join(DRAWS)}")
    if variable.size > MOST_MEMBERS:
        raise DataError(f"{path}: {variable.size} members of {variable.name}; at most {MOST_MEMBERS}")
    if getattr(variable.dtype, "kind", "O") not in "fiub":
        raise DataError(f"{path}: {variable.name} holds no numbers")
    return floats(variable[:]).ravel()
