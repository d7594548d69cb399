"""What a worker writes without xarray is what xarray would have written."""

from __future__ import annotations

import netCDF4
import numpy as np
import pytest

from en4dvar.report.result import Result
from en4dvar.storage import netcdf
from en4dvar.storage.groups import build_groups
from en4dvar.storage.netcdf import Group, Variable, to_bytes, tree_of
from en4dvar.storage.store import save
from en4dvar.summary import summarise


def contents(group, name=""):
    """Everything a netCDF file holds, as the library without any convention sees it."""
    found = {(name, "dimensions"): {n: len(d) for n, d in group.dimensions.items()}}
    found[name, "attributes"] = {n: str(group.getncattr(n)) for n in group.ncattrs()}
    for key, variable in group.variables.items():
        variable.set_auto_maskandscale(False)
        attributes = {n: str(variable.getncattr(n)) for n in variable.ncattrs()}
        values = np.asarray(variable[...]).tolist()
        found[name, key] = str((variable.dtype, variable.dimensions, sorted(attributes.items()), values))
    for key, child in group.groups.items():
        found |= contents(child, f"{name}/{key}")
    return found


def test_file_is_what_xarray_would_write(analysis, tmp_path):
    to_bytes(build_groups(analysis, {"note": "x"})).write(tmp_path / "ours.nc")
    save(Result.from_analysis(analysis, {"note": "x"}), tmp_path / "xarray.nc")
    with netCDF4.Dataset(tmp_path / "ours.nc") as ours, netCDF4.Dataset(tmp_path / "xarray.nc") as theirs:
        assert contents(ours) == contents(theirs)


def test_large_variables_are_written_in_blocks(tmp_path, monkeypatch):
    values = np.arange(60.0).reshape(10, 6)[:, 1:] / 7
    groups = {"/": Group({"x": Variable(("a", "b"), values, {}, single=True), "y": Variable(("c",), values[0], {})})}
    to_bytes(groups).write(tmp_path / "whole.nc")
    monkeypatch.setattr(netcdf, "_LARGE", 100)  # two rows and a half
    to_bytes(groups).write(tmp_path / "blocks.nc")
    with netCDF4.Dataset(tmp_path / "whole.nc") as whole, netCDF4.Dataset(tmp_path / "blocks.nc") as blocks:
        assert contents(whole) == contents(blocks)
        assert np.array_equal(blocks["x"][...], values.astype(np.float32))
        assert blocks["x"].dtype == np.float32
    assert tree_of(groups)["x"].dtype == np.float32


def test_summary_of_the_analysis_is_that_of_the_result(analysis):
    assert summarise(analysis) == Result.from_analysis(analysis, {}).summary()


@pytest.mark.parametrize("survivors", [0, 1])
def test_summary_without_survivors(make_analysis, survivors):
    analysis = make_analysis(5, posterior_failures=tuple("x" if i >= survivors else "" for i in range(5)))
    found, expected = summarise(analysis), Result.from_analysis(analysis, {}).summary()
    np.testing.assert_equal([vars(row) for row in found], [vars(row) for row in expected])
    assert np.isnan(found[0].std)
