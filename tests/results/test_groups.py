"""What is written and read without xarray is what xarray would have written and read."""

from __future__ import annotations

from dataclasses import replace

import netCDF4
import numpy as np
import pytest
import xarray as xr

from en4dvar.diagnosis.diagnostics import active_members, member_quantiles
from en4dvar.plumbing.caution import untrusted
from en4dvar.plumbing.units import convert
from en4dvar.report.result import Result
from en4dvar.results import netcdf
from en4dvar.results.netcdf import Group, Variable, read_groups, seal_file, to_bytes, tree_of
from en4dvar.results.store import build_groups


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
    tree_of(build_groups(analysis, {"note": "x"})).to_netcdf(tmp_path / "xarray.nc", engine="netcdf4")
    with netCDF4.Dataset(tmp_path / "ours.nc") as ours, netCDF4.Dataset(tmp_path / "xarray.nc") as theirs:
        assert contents(ours) == contents(theirs)


@pytest.mark.parametrize("writer", ["ours", "xarray"])
def test_a_file_is_read_as_xarray_reads_it(make_analysis, tmp_path, writer):
    """Missing values, truth values, texts, numbers without dimension, and coordinates that are no dimension."""
    analysis = make_analysis(posterior_failures=("lost", *[""] * 23))
    groups, path = build_groups(analysis, {"note": "x", "flag": True, "numbers": np.arange(3.0)}), tmp_path / "file.nc"
    aside = {"where": Variable(("draw",), np.arange(24.0), {"units": "m"}), "once": Variable((), np.array("äö"), {})}
    posterior = groups["/posterior"]
    groups["/posterior"] = replace(posterior, variables={**posterior.variables, **aside})
    if writer == "ours":
        to_bytes(groups).write(path)
    else:
        tree = tree_of(groups)
        tree["posterior"] = tree["posterior"].to_dataset().set_coords("where")
        tree.to_netcdf(path, engine="netcdf4")
        seal_file(path)
    found = tree_of(read_groups(path))
    with xr.open_datatree(path, engine="netcdf4", decode_timedelta=False) as expected:
        xr.testing.assert_identical(found, expected.load())
        for node in expected.subtree:
            for name, variable in node.variables.items():
                again = found[node.path].variables[name].dtype
                assert again == variable.dtype or {again.kind, variable.dtype.kind} <= set("OU"), name
    assert ("where" in found["posterior"].coords) == (writer == "xarray")


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


def shown(analysis, members):
    """(n, N) in display units."""
    return [convert(values, p.unit, p.display_unit) for values, p in zip(members.T, analysis.parameters, strict=True)]


def test_rows_of_the_result_are_those_of_the_analysis(analysis):
    alive = active_members(analysis.posterior_failures)
    members = shown(analysis, analysis.prior), shown(analysis, analysis.posterior[alive])
    own = zip(*members, shown(analysis, analysis.centre[None]), analysis.dfs_per_parameter, strict=True)
    rows = Result.from_analysis(analysis, {}).rows
    assert [row.name for row in rows] == [p.name for p in analysis.parameters]
    for row, (prior, posterior, centre, dfs) in zip(rows, own, strict=True):
        quantiles = member_quantiles(posterior, (0.05, 0.5, 0.95))
        expected = prior.mean(), prior.std(ddof=1), posterior.mean(), posterior.std(ddof=1), *quantiles, *centre, dfs
        told = (row.prior_mean, row.prior_std, row.mean, row.std, row.q05, row.q50, row.q95, row.centre, row.dfs)
        np.testing.assert_allclose(told, expected, rtol=1e-12)
        assert row.untrusted == untrusted(analysis.cautions, row.name)


@pytest.mark.parametrize("survivors", [0, 1])
def test_summary_without_survivors(make_analysis, survivors):
    analysis = make_analysis(5, posterior_failures=tuple("x" if i >= survivors else "" for i in range(5)))
    rows, values = Result.from_analysis(analysis, {}).rows, shown(analysis, analysis.posterior[:1])
    for row, (only,) in zip(rows, values, strict=True):
        np.testing.assert_equal([row.mean, row.q05, row.q95], [only if survivors else np.nan] * 3)
        assert np.isnan(row.std)
