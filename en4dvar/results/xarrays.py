"""Groups of variables as xarray shows them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from en4dvar.results.netcdf import Group, Groups, Variable

if TYPE_CHECKING:
    import xarray as xr


def tree_of(groups: Groups) -> xr.DataTree:
    """All groups, by path."""
    import xarray as xr

    return xr.DataTree.from_dict({path: dataset_of(group) for path, group in groups.items()})


def dataset_of(group: Group) -> xr.Dataset:
    """One group."""
    import xarray as xr

    def shown(v: Variable) -> xr.Variable:
        return xr.Variable(v.dims, v.stored, v.attrs, {} if v.fill else {"_FillValue": None})

    variables, coords = ({name: shown(v) for name, v in part.items()} for part in (group.variables, group.coords))
    return xr.Dataset(variables, coords, group.attrs)
