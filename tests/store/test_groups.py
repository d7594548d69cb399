"""What a worker writes without xarray is what xarray would have written."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from en4dvar.report.result import Result
from en4dvar.storage.groups import build_groups
from en4dvar.storage.netcdf import groups_of, to_bytes, tree_of
from en4dvar.summary import summarise


def test_file_of_the_groups_is_the_file_of_their_tree(analysis):
    groups = build_groups(analysis, {"note": "x"})
    tree = tree_of(groups)
    assert to_bytes(groups) == to_bytes(tree)
    for path, group in groups_of(tree).items():
        given = groups[path]
        assert (group.variables.keys(), group.coords.keys()) == (given.variables.keys(), given.coords.keys())
        assert group.sizes == given.sizes
        for name, variable in {**given.variables, **given.coords}.items():
            again = {**group.variables, **group.coords}[name]
            assert (again.dims, again.attrs, again.fill) == (variable.dims, variable.attrs, variable.fill)
            np.testing.assert_array_equal(again.values, variable.values)


def test_summary_of_the_analysis_is_that_of_the_result(analysis):
    assert summarise(analysis) == Result.from_analysis(analysis, {}).summary()


def test_coordinates_that_are_no_dimension_are_named(tmp_path):
    """As xarray writes them, so that it finds them again."""
    data = xr.Dataset(
        {"a": ("x", [1.0, np.nan]), "b": ((), 2)},
        {"x": [0, 1], "label": ("x", np.array(["p", "q"], dtype=object)), "elsewhere": ("z", [1.0])},
        {"k": 1},
    )
    path = tmp_path / "file.nc"
    path.write_bytes(to_bytes(xr.DataTree.from_dict({"/g": data})))
    with xr.open_dataset(path, group="g") as read:
        assert set(read.coords) == {"x", "label", "elsewhere"}
        xr.testing.assert_identical(read.load(), data)


@pytest.mark.parametrize("survivors", [0, 1])
def test_summary_without_survivors(make_analysis, survivors):
    analysis = make_analysis(5, posterior_failures=tuple("x" if i >= survivors else "" for i in range(5)))
    found, expected = summarise(analysis), Result.from_analysis(analysis, {}).summary()
    np.testing.assert_equal([vars(row) for row in found], [vars(row) for row in expected])
    assert np.isnan(found[0].std)
