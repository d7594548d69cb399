"""Groups of a file that stand beside those of ArviZ.

Tools take every variable of the observed data for one that is predicted, and every dimension of the predictions for one
of the readings. So the errors of the readings and the paths between them have groups of their own.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import xarray as xr

BESIDE: Mapping[str, str] = {
    "observed_data": "observation_errors",
    "prior_predictive": "prior_paths",
    "posterior_predictive": "posterior_paths",
}


def joined(group: xr.Dataset, beside: xr.Dataset | None) -> xr.Dataset:
    """A group with the variables of the one beside it; files of earlier versions have all in one."""
    import xarray as xr

    if beside is None:
        return group
    coords = {name: one.variable for part in (group, beside) for name, one in part.coords.items()}
    held = {name: one.variable for part in (group, beside) for name, one in part.data_vars.items()}
    indexes = {**beside.xindexes, **group.xindexes}  # of the same file: nothing to align, which takes ten times as long
    return xr.Dataset(held, xr.Coordinates(coords, indexes), group.attrs)
