"""Whether a file with a good seal holds what a result consists of: anybody can seal a file."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from en4dvar.config.symbols import symbol_fault
from en4dvar.errors import OutputError
from en4dvar.storage.axes import Axis, axes_of
from en4dvar.storage.beside import joined
from en4dvar.storage.netcdf import Group, Groups, Variable
from en4dvar.storage.readings import MEMBER
from en4dvar.units import UnitError, convert

_GROUPS = (
    "prior", "posterior", "prior_predictive", "posterior_predictive", "observed_data", "constant_data", "sample_stats",
    "log_likelihood", "iterations",
)  # fmt: skip
_ATTRIBUTES = {
    "/": ("dataset", "warnings", "assimilation_settings"),
    "/observed_data": ("data_source",),
    "/sample_stats": (
        "n_members", "n_active", "n_observations", "n_weighted", "nrmse", "chi2_per_observation", "dfs",
        "n_iterations", "converged", "stop_reason", "forward_runs",
    ),
}  # fmt: skip
# Variables that are read, * for each parameter and % for each series; @ begins one that a single series has under the
# name behind it, several under their own.
_VARIABLES = {
    "/prior": "*",
    "/prior_predictive": "%",
    "/posterior_predictive": "%",
    "/observed_data": "% %_std %_reading_std @time_std @weights @time",
    "/sample_stats": "active failure_reason centre dfs %_centre parameter",
    "/iterations": "J J_background J_observation step_norm step_length chi2_per_observation dfs spread active *"
    " *_centre",
}
_SHOWN = ("", "_std", "_reading_std", "_path")  # of the observable, in its display unit
_NAMED = ("/prior", "/posterior", "/constant_data")  # groups whose variables go into tables and labels


def check_complete(path: Path, groups: Groups) -> None:
    """Check the groups of a file. Raises :class:`OutputError`, which names what is missing."""
    for fault in _faults({path: joined(groups, path) for path in groups}):
        raise OutputError(f"{path}: not a result of en4dvar: {fault}")


def of_members(group: Group) -> dict[str, Variable]:
    """The parameters of a group, without the values of pieces of time: what has one number a member."""
    return {name: variable for name, variable in group.variables.items() if variable.dims == MEMBER}


def _faults(nodes: Groups) -> Iterator[str]:
    if missing := [group for group in _GROUPS if f"/{group}" not in nodes]:
        yield f"no group {', '.join(missing)}"
    for group, attributes in _ATTRIBUTES.items():
        if missing := [name for name in attributes if name not in nodes[group].attrs]:
            yield f"{group} has no attribute {', '.join(missing)}"
    parameters = of_members(nodes["/posterior"])
    axes = axes_of(list(nodes["/log_likelihood"].variables))
    if not axes:
        yield "/log_likelihood has no variable"
    named = {"*": list(parameters), "%": [axis.name for axis in axes], "@": [axis.own("") for axis in axes]}
    for group, names in {**_VARIABLES, "/posterior": "*", "/constant_data": ""}.items():
        held, group_needs = nodes[group].every, list(_expanded(names, named))
        if missing := [name for name in group_needs if name not in held]:
            yield f"{group} has no variable {', '.join(missing)}"
        yield from _curve_faults(group, nodes[group], axes, nodes["/observed_data"])
        yield from _label_faults(group, nodes[group], axes)


def _expanded(names: str, named: Mapping[str, list[str]]) -> Iterator[str]:
    for name in names.split():
        yield from (name.replace(name[0], one, 1) for one in named.get(name[0], [name[0]]))


def _curve_faults(name: str, group: Group, axes: Sequence[Axis], observed: Group) -> Iterator[str]:
    """Curves along the path, which a series has but for one of a field."""
    if not name.endswith("_predictive"):
        return
    for axis in axes:
        if f"{axis.name}_path" not in group.variables and f"{axis.name}_place" not in observed.every:
            yield f"{name} has no variable {axis.name}_path"
        elif f"{axis.name}_path" in group.variables and "path_time" not in group.every:
            yield f"{name} has no variable path_time"


def _label_faults(group: str, content: Group, axes: Sequence[Axis]) -> Iterator[str]:
    """What keeps variables with a display unit or a symbol from being shown."""
    times, names = [axis.time for axis in axes], [axis.name for axis in axes]
    displayed = ("path_time", *times, *(name + end for name in names for end in _SHOWN))
    for name, variable in content.every.items():
        about = variable.attrs
        wanted = ["units"]
        if group in _NAMED and name not in ("chain", "draw"):
            wanted += ["long_name", "symbol", *["display_units"] * (group != "/constant_data")]
        elif name in displayed or "symbol" in about:
            wanted += ["display_units"]
        if group == "/observed_data" and name in names:
            wanted += ["long_name", "symbol"]
        if missing := [key for key in wanted if key not in about]:
            yield f"{group}/{name} has no attribute {', '.join(missing)}"
        try:
            convert(1.0, str(about["units"]), str(about.get("display_units", about["units"])))
        except UnitError as error:
            yield f"{group}/{name}: {error}"
        for key in ("symbol", "long_name"):
            if reason := symbol_fault(str(about.get(key, ""))):
                yield f"{group}/{name}: its {key} cannot be written in a figure: {reason}"
