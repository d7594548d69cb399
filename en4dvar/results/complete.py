"""The check that a file with a good seal holds what a result consists of, for anybody can seal a file.

Some groups stand beside those of ArviZ: tools take every variable of the observed data for one that is predicted, and
every dimension of the predictions for one of the readings. So errors of readings and paths have groups of their own.
"""

from collections.abc import Iterator, Mapping
from functools import lru_cache
from pathlib import Path

from en4dvar.config.models import symbol_fault
from en4dvar.plumbing.errors import OutputError
from en4dvar.plumbing.units import UnitError, convert
from en4dvar.results.declared import MEMBER, Declared, axes_of
from en4dvar.results.netcdf import Group, Groups, Variable
from en4dvar.results.scalars import ATTRIBUTES
from en4dvar.results.variables import COORDINATES, GROUPS, OPTIONAL

BESIDE: Mapping[str, str] = {
    "observed_data": "observation_errors",
    "prior_predictive": "prior_paths",
    "posterior_predictive": "posterior_paths",
}


def joined(groups: Groups, path: str) -> Group:
    """A group with the variables of the one beside it; files of earlier versions have all in one."""
    group, beside = groups[path], groups.get(f"/{BESIDE.get(path[1:])}")
    if beside is None:
        return group
    return Group({**group.variables, **beside.variables}, {**group.coords, **beside.coords}, group.attrs)


_OPTIONAL = OPTIONAL | {*(f"/{name}" for name in BESIDE.values())}


def check_complete(path: Path, groups: Groups) -> None:
    """Check the groups of a file. Raises :class:`OutputError`, which names what is missing."""
    for fault in _faults({path: joined(groups, path) for path in groups}):
        raise OutputError(f"{path}: not a result of en4dvar: {fault}")


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
        needed = {dim for variable in content.variables.values() for dim in variable.dims} & declared[
            "coordinates"
        ].keys()
        needed |= {name for name, d in declared[path].items() if d.needed}
        if missing := sorted(name for name in needed if name not in content):
            yield f"{path} has no variable {', '.join(missing)}"
        yield from _curve_faults(path, content, nodes)
        yield from _label_faults(path, content, declared["coordinates"] | declared[path])


@lru_cache(maxsize=8)
def _declared(
    series_names: tuple[str, ...], fixed: tuple[str, ...], parameters: tuple[str, ...]
) -> dict[str, dict[str, Declared]]:
    """By group, the declarations of the variables that it may have, by name; those of coordinates by themselves."""
    axes = axes_of(series_names)
    series = [{"series": axis.name, "shared": axis.own(""), "time": axis.time} for axis in axes]
    names: dict[str, list[dict[str, str]]] = {
        "parameter": [{"parameter": name} for name in parameters],
        "fixed": [{"fixed": name} for name in fixed],
        **dict.fromkeys(("series", "shared", "time"), series),
    }
    tables = {path: (*table, *GROUPS.get(f"/{BESIDE.get(path[1:])}", ())) for path, table in GROUPS.items()}
    tables["coordinates"] = COORDINATES
    return {path: {name: d for d in table for name in d.expanded(names)} for path, table in tables.items()}


def _curve_faults(path: str, group: Group, nodes: Groups) -> Iterator[str]:
    """Each series has a curve along the path, except one of a field."""
    for name in nodes["/log_likelihood"].variables if path.endswith("_predictive") else ():
        if f"{name}_path" not in group and f"{name}_place" not in nodes["/observed_data"]:
            yield f"{path} has no variable {name}_path"


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
