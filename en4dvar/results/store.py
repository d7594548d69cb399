"""A stored result: what a run hands back, as its groups, without xarray; an analysis laid out in the ArviZ schema.

Errors of readings and paths have groups of their own beside those of ArviZ: tools take every variable of the observed
data for one that is predicted, and every dimension of the predictions for one of the readings.

A file that is read is checked for what a result consists of, also behind a good seal, for anybody can seal a file.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Self

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_array

from en4dvar.config.models import symbol_fault
from en4dvar.data.noise import SIDES, noise_of_readings, noise_of_record, recorded
from en4dvar.data.observations import Observations
from en4dvar.data.series import Part, Places
from en4dvar.diagnosis.analysis import Analysis
from en4dvar.estimation.summary import ParameterSummary, brief, results_table
from en4dvar.model.forward import Observable, Trajectory
from en4dvar.model.state import Array, Parameter
from en4dvar.plumbing.called import CONTINUED, advised
from en4dvar.plumbing.errors import OutputError, retold
from en4dvar.plumbing.hints import counted
from en4dvar.plumbing.units import UnitError, convert
from en4dvar.results.declared import MEMBER, Axis, Declared, Stored, axes_of, group_of, lay_out, parameter_of, zero_of
from en4dvar.results.kinds import require_no_other
from en4dvar.results.netcdf import Group, Groups, Variable, read_groups, understood
from en4dvar.results.pack import PACK, file_names, read_result, results_of, unpacked
from en4dvar.results.scalars import ATTRIBUTES, SCALAR
from en4dvar.results.variables import BESIDE, COORDINATES, GROUPS, OPTIONAL, SCOPES

NEXT = ".en4dvar-next"  # in a run directory: the run that replaces its result
COMPLETE = ".en4dvar-complete"  # in that: it is being put in place


@dataclass(frozen=True)
class StoredResult(Stored):
    """The posterior ensemble of one data set with everything that led to it: a thin view of ``groups``. Values are SI;
    members are draws of one chain; a failed member is NaN and ``active`` is False there.
    """

    @classmethod
    def from_analysis(cls, analysis: Analysis, attributes: Mapping[str, Any]) -> Self:
        """Lay out an analysis; ``attributes`` (see :func:`en4dvar.results.provenance.provenance`) join the root's."""
        return cls(build_groups(analysis, attributes))

    def with_attributes(self, path: str, /, **attributes: str) -> Self:
        """With other attributes of a group, ``"/"`` is the root."""
        group = self.groups[path]
        return type(self)({**self.groups, path: replace(group, attrs={**group.attrs, **attributes})})

    def group(self, name: str) -> Group:
        """A group of the file, e.g. ``"prior_predictive"``, with the variables of the group beside it."""
        return joined(self.groups, f"/{name}")

    @property
    def name(self) -> str:
        """Name of the data set."""
        return str(self.attributes["dataset"])

    @property
    def parameters(self) -> dict[str, Variable]:
        """Members (chain, draw) of the posterior, by parameter."""
        return of_members(self.groups["/posterior"])

    @property
    def axes(self) -> tuple[Axis, ...]:
        """The series of the data set, and how their variables are called."""
        return axes_of(list(self.groups["/log_likelihood"].variables))

    @property
    def observable(self) -> str:
        """Name of the observed quantity; of several series that of the first."""
        return self.axes[0].name

    @property
    def warnings(self) -> tuple[str, ...]:
        """The words of the cautions."""
        return tuple(c.words for c in self.cautions)

    @property
    def alive(self) -> npt.NDArray[np.bool_]:
        """(N,) the members that survived the posterior forecast."""
        return np.asarray(self.groups["/sample_stats"]["active"].values.ravel(), dtype=bool)

    def of_readings(self, group: str, name: str, shared: bool = False) -> Array:
        """(…, K) of all readings, one series after the other: the variables ``<series>_<name>``, or of a single series
        ``name`` where that is ``shared``, as ``weights`` are."""
        held, names = self.group(group), [a.own(name) if shared else f"{a.name}_{name}" for a in self.axes]
        return np.concatenate([held[name].values for name in names], axis=-1)

    def of_parameter(self, variable: str, name: str) -> float:
        """What ``variable`` of ``sample_stats`` is for a parameter, SI."""
        stats = self.groups["/sample_stats"]
        return float(stats[variable].values[stats["parameter"].values.tolist().index(name)])

    def members(self, group: str, name: str) -> Array:
        """(N',) finite values of a parameter in ``group`` (prior or posterior), display unit, members in order."""
        values = np.asarray(self.groups[f"/{group}"][name].values, dtype=float).ravel()
        p, alive = self._parameter(name), self.alive if group == "posterior" else True
        return np.asarray(convert(values[np.isfinite(values) & alive], p.unit, p.display_unit))

    @property
    def rows(self) -> tuple[ParameterSummary, ...]:
        """One row a parameter: prior, mean, std (N−1), 5/50/95 %, centre, DFS; NaN where too few members live."""
        cautions = self.cautions

        def row(name: str) -> ParameterSummary:
            prior, posterior = self.members("prior", name), self.members("posterior", name)
            centre, dfs = (self.of_parameter(key, name) for key in ("centre", "dfs"))
            return ParameterSummary.of(self._parameter(name), prior, posterior, centre, dfs, cautions)

        return tuple(map(row, self.parameters))

    def centres(self, names: Sequence[str]) -> Array:
        """(n,) of the parameters, SI."""
        return np.array([self.of_parameter("centre", name) for name in names])

    def observations(self, observables: Mapping[str, Observable] | None = None) -> Observations:
        """The observations (y, t, R) that the result was estimated from, to the bit. ``observables``: what the series
        hold, by their names; the file does not know how a model predicts them.
        """
        held, axes, later = "observed_data", self.axes, self.groups.get("/withheld")
        data, std = self.group(held), self.of_readings(held, "reading_std")
        times, time_std = (self.of_readings(held, key, shared=True) for key in ("time", "time_std"))
        parts, zeros = _parts(data, axes, observables or {}), [zero_of(data[axis.time]) for axis in axes]
        if parts:
            matrix = _correlation(data, len(times))
            within = [float(data.attrs.get(f"{p.name}_huber_threshold", math.inf)) for p in parts]
            thresholds = np.repeat(within, [p.end - p.begin for p in parts])
            sides = data[SIDES].values if SIDES in data else None
            noise = noise_of_readings(std, time_std, matrix, thresholds, sides)
        else:
            own = {key.removeprefix(f"{axes[0].name}_"): value.values for key, value in data.variables.items()}
            noise = noise_of_record(times, std, time_std, own, data.attrs)
        return Observations(
            times=times,
            values=np.concatenate([data[axis.name].values for axis in axes]),
            noise=noise,
            weights=self.of_readings(held, "weights", shared=True),
            name=self.name,
            source=str(data.attrs["data_source"]),
            scalars={k.removeprefix(SCALAR): float(v) for k, v in data.attrs.items() if k.startswith(SCALAR)},
            parts=parts,
            continued=None if later is None else _continued(data, later, axes[0].name, self.name),
            zero=np.repeat(zeros, [len(data[axis.time].values) for axis in axes]) if len(axes) > 1 else zeros[0],
        )

    @property
    def ended(self) -> str:
        """How the fit ended, in words."""
        s = self.groups["/sample_stats"].attrs
        ended = f"{'converged' if s['converged'] else 'not converged'}: {s['stop_reason']}"
        return f"{ended}; chi2/K {s['chi2_per_observation']:.3g}, NRMSE {s['nrmse']:.3g}, DFS {s['dfs']:.3g}"

    def __repr__(self) -> str:
        warned = f", {counted(len(self.warnings), 'warning')}" if self.warnings else ""
        return f"<{type(self).__name__} {self.name}: {brief(self.rows)}; {self.ended.partition(':')[0]}{warned}>"

    def __str__(self) -> str:
        """The summary as a table (display units), how the fit ended, and the warnings with what to do."""
        parts = [results_table({self.name: self.rows}), self.ended]
        return "\n".join([*parts, *(f"{caution.kind}: {caution}" for caution in self.cautions)])

    def _parameter(self, name: str) -> Parameter:
        return parameter_of(name, self.groups["/posterior"][name].attrs)


def require_settled(run_dir: Path) -> None:
    """Raise :class:`OutputError` where files of two runs may lie side by side."""
    if (run_dir / NEXT / COMPLETE).exists():
        words = "a run was killed while its files took the place of an earlier run's"
        raise OutputError(f"{run_dir}: {words}; {advised(*CONTINUED)} finishes that")


def posterior_file(run_dir: str | Path) -> Path:
    """The netCDF file of a run or campaign, in the ArviZ schema as it is. Raises :class:`OutputError`."""
    path = Path(run_dir) / "posterior.nc"
    require_settled(path.parent)
    if not path.is_file():
        require_no_other(path.parent)
        lacks = "holds no posterior.nc; is it the directory of a finished run?"
        raise OutputError(f"{run_dir}: {lacks if path.parent.exists() else 'no such file or directory'}")
    return path


def load_stored(path: str | Path) -> StoredResult:
    """Read ``posterior.nc``, or an address in a pack. Raises :class:`OutputError`: no result, cut short or altered."""
    path = Path(path)
    if path.name == PACK and path.is_file() and (held := results_of(path)):
        raise OutputError(f"{path}: a campaign of {len(held)} data sets; give the address of one, such as {held[0]}")
    with retold(ValueError, OutputError, f"{path}: not a result of en4dvar: "):  # anybody can write a checksum
        groups = unpacked(read_result(path)) if path.parent.name == PACK else read_groups(path)
        for path_in_file, group in groups.items():
            group.check()
            joined(groups, path_in_file).check()
    with understood(path):
        if "/alone" in groups:
            words = f"what several data sets say together, not the result of one; its numbers are in {path.stem}.csv"
            raise OutputError(f"{path}: {words}, its draws are read by xarray.open_datatree")
        if "/posterior" in groups and "dataset" in groups["/posterior"]:
            stems = list(file_names(map(str, groups["/posterior"]["dataset"].values)).values())
            hint = f"such as {path.parent / PACK / stems[0]}, or open all of them with xarray.open_datatree"
            raise OutputError(f"{path}: a campaign of {len(stems)} data sets; give the address of one, {hint}")
        for fault in _faults({path_in_file: joined(groups, path_in_file) for path_in_file in groups}):
            raise OutputError(f"{path}: not a result of en4dvar: {fault}")
    return StoredResult(groups)


def build_groups(a: Analysis, attributes: Mapping[str, Any]) -> dict[str, Group]:
    """All groups of an analysis by path; ``attributes`` are added to the root's and win over the defaults."""
    coordinates = lay_out(COORDINATES, a, SCOPES)
    groups = {"/": group_of({}, {}, ATTRIBUTES["/"], a, **attributes)}
    for path, table in GROUPS.items():
        variables = lay_out(table, a, SCOPES)
        if variables or path not in OPTIONAL:
            groups[path] = group_of(variables, coordinates, ATTRIBUTES.get(path, ()), a)
    return groups


# The check of what is read


def joined(groups: Groups, path: str) -> Group:
    """A group with the variables of the one beside it; files of earlier versions have all in one."""
    group, beside = groups[path], groups.get(BESIDE.get(path, ""))
    if beside is None:
        return group
    return Group({**group.variables, **beside.variables}, {**group.coords, **beside.coords}, group.attrs)


_OPTIONAL = OPTIONAL | {*BESIDE.values()}


def of_members(group: Group) -> dict[str, Variable]:
    """The variables of a group with one number a member: its parameters, without their values over pieces of time."""
    return {name: variable for name, variable in group.variables.items() if variable.dims == tuple(MEMBER.split())}


def _faults(nodes: Groups) -> Iterator[str]:
    required = [path for path in GROUPS if path not in _OPTIONAL]
    if missing := [path[1:] for path in required if path not in nodes]:
        yield f"no group {', '.join(missing)}"
    for path, attributes in ATTRIBUTES.items():
        if missing := [a.name for a in attributes if a.needed and a.name not in nodes[path].attrs]:
            yield f"{path} has no attribute {', '.join(missing)}"
    if not nodes["/log_likelihood"].variables:
        yield "/log_likelihood has no variable"
    held = (tuple(nodes[path].variables) for path in ("/log_likelihood", "/constant_data"))
    declared = _declared(*held, tuple(of_members(nodes["/posterior"])))
    for path in required:
        content = nodes[path]
        dims = {dim for variable in content.variables.values() for dim in variable.dims}
        needed = dims & declared["coordinates"].keys() | {name for name, d in declared[path].items() if d.needed}
        if missing := sorted(name for name in needed if name not in content):
            yield f"{path} has no variable {', '.join(missing)}"
        for name in nodes["/log_likelihood"].variables if path.endswith("_predictive") else ():
            if f"{name}_path" not in content and f"{name}_place" not in nodes["/observed_data"]:
                yield f"{path} has no variable {name}_path"  # which each series has but one of a field
        yield from _label_faults(path, content, declared["coordinates"] | declared[path])


@lru_cache(maxsize=8)
def _declared(
    series_names: tuple[str, ...], fixed: tuple[str, ...], parameters: tuple[str, ...]
) -> dict[str, dict[str, Declared]]:
    """By group, the declarations of the variables that it may have, by name; those of coordinates by themselves."""
    series = [{"series": axis.name, "shared": axis.own(""), "time": axis.time} for axis in axes_of(series_names)]
    names: dict[str, list[dict[str, str]]] = {
        "": [{}],
        "parameter": [{"parameter": name} for name in parameters],
        "fixed": [{"fixed": name} for name in fixed],
        **dict.fromkeys(("series", "shared", "time"), series),
    }
    tables = {path: (*table, *GROUPS.get(BESIDE.get(path, ""), ())) for path, table in GROUPS.items()}
    tables["coordinates"] = COORDINATES
    return {
        path: {d.name.format(**of_item): d for d in table for of_item in names.get(d.scope, ())}
        for path, table in tables.items()
    }


def _label_faults(path: str, group: Group, declared: Mapping[str, Declared]) -> Iterator[str]:
    """What keeps variables from being shown: other dimensions, a label or unit that is missing or means nothing."""
    for name, variable in group.every.items():
        about = variable.attrs
        wanted = ["units", *["display_units"] * ("symbol" in about)]
        if name in declared:
            wanted, dims = [*declared[name].unit.keys, "long_name"], declared[name].dims.split()
            if len(dims) != len(variable.dims):
                yield f"{path}/{name} has {len(variable.dims)} dimensions instead of {len(dims)}"
        if missing := [key for key in wanted if key not in about]:
            yield f"{path}/{name} has no attribute {', '.join(missing)}"
        try:
            convert(1.0, str(about["units"]), str(about.get("display_units", about["units"])))
        except UnitError as error:
            yield f"{path}/{name}: {error}"
        for key in ("symbol", "long_name"):
            if reason := symbol_fault(str(about.get(key, ""))):
                yield f"{path}/{name}: its {key} cannot be written in a figure: {reason}"


# Parts of the observations of a file


def _continued(data: Group, later: Group, series: str, name: str) -> Observations:

    def both(of_window: str, after: str = "") -> Array:
        return np.concatenate([data[of_window].values, later[after or of_window].values])

    times, std = both("time", "withheld_time"), both(f"{series}_reading_std")
    noise = noise_of_record(times, std, both("time_std"), {}, data.attrs)
    return Observations(times, both(series), noise, np.ones(len(times)), name, zero=zero_of(data["time"]))


def _correlation(data: Group, count: int) -> csr_array | None:
    """Of all readings, from its entries that are not zero or whatever else is recorded; None where there is none."""
    if "correlation_row" in data:
        rows, columns = (data[f"correlation_{side}"].values for side in ("row", "column"))
        return csr_array((data["correlation"].values, (rows, columns)), shape=(count, count))
    held = recorded({key: variable.values for key, variable in data.variables.items()})
    return None if held is None else csr_array(held if isinstance(held, np.ndarray) else held.matrix)


def _parts(data: Group, axes: Sequence[Axis], observables: Mapping[str, Observable]) -> tuple[Part, ...]:
    """The series; () of a single one without places."""
    ends = np.cumsum([len(data[axis.name].values) for axis in axes]).tolist()
    parts = [
        Part(axis.name, observables.get(axis.name) or _unread(data, axis), begin, end, _places(data, axis))
        for axis, begin, end in zip(axes, [0, *ends], ends, strict=False)
    ]
    return () if len(parts) == 1 and parts[0].places is None else tuple(parts)


def _places(data: Group, axis: Axis) -> Places | None:
    name = f"{axis.name}_place"
    if name not in data:
        return None
    indices, shares = data[f"{name}_index"].values.astype(np.intp), data[f"{name}_share"].values
    return Places(indices, shares, data[name].values, str(data[name].attrs["units"]))


def _unread(data: Group, axis: Axis) -> Observable:
    """What a file knows of an observable; only a model knows how it is predicted."""

    def refuse(trajectory: Trajectory) -> Array:
        raise NotImplementedError(f"{axis.name} is that of a file; give the model's observable")

    about = data[axis.name].attrs
    label = str(about["long_name"]).removesuffix(", observed")
    return Observable(axis.name, about["units"], refuse, about["symbol"], about["display_units"], label)
