"""Groups of a file that stand beside those of ArviZ.

Tools take every variable of the observed data for one that is predicted, and every dimension of the predictions for one
of the readings. So the errors of the readings and the paths between them have groups of their own.
"""

from __future__ import annotations

from collections.abc import Mapping

from en4dvar.results.netcdf import Group, Groups

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
