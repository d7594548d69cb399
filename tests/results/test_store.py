"""A result file holds all groups, comes back as it was, and opens in the tools of the field."""

from __future__ import annotations

import warnings
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import netCDF4
import numpy as np
import pytest
import xarray as xr

from en4dvar.diagnosis.diagnostics import member_quantiles
from en4dvar.plumbing.errors import OutputError
from en4dvar.report.result import Result, load_result
from en4dvar.results.netcdf import SealedBytes
from en4dvar.results.provenance import git_commit, provenance
from en4dvar.results.variables import BESIDE

FAILED = 3
GROUPS = {
    "prior", "posterior", "prior_predictive", "posterior_predictive", "observed_data", "observation_errors",
    "prior_paths", "posterior_paths", "constant_data", "sample_stats", "log_likelihood", "iterations",
}  # fmt: skip


@pytest.fixture(scope="module")
def result(analysis):
    return Result.from_analysis(analysis, provenance("prior: {G: 1 kPa}\n"))


@pytest.fixture(scope="module")
def path(result, tmp_path_factory):
    """Its file, which tests read."""
    return result.save(tmp_path_factory.mktemp("stored") / "posterior.nc")


def test_file_has_every_group_with_units_and_names(path):
    with xr.open_datatree(path) as tree:
        assert set(tree.children) == GROUPS
        for node in tree.subtree:
            for name, variable in {**node.data_vars, **node.coords}.items():
                assert variable.attrs["units"], f"{node.path}/{name}"
                assert variable.attrs["long_name"], f"{node.path}/{name}"
        assert tree["posterior/G"].dims == ("chain", "draw")
        assert tree["posterior_predictive/R"].dims == ("chain", "draw", "time")
        assert tree["posterior_paths/R_path"].dims == ("chain", "draw", "path_time")
        assert tree["log_likelihood/R"].dims == ("chain", "draw", "time")
        assert tree["iterations/G"].dims == ("iteration", "draw")
        assert tree["constant_data/p_inf"].item() == 101325.0
        assert tree["posterior/G"].attrs["display_units"] == "kPa"
        assert tree["observed_data/R"].attrs["units"] == "m"


def test_values_are_those_of_the_analysis(path, analysis):
    loaded = load_result(path)
    for i, parameter in enumerate(analysis.parameters):
        np.testing.assert_array_equal(loaded.prior[parameter.name].values[0], analysis.prior[:, i])
        np.testing.assert_array_equal(loaded.posterior[parameter.name].values[0], analysis.posterior[:, i])
        trace = np.stack([r.members[:, i] for r in analysis.iterations])
        np.testing.assert_array_equal(loaded.iterations[parameter.name].values, trace)
    np.testing.assert_array_equal(loaded.observed_data["R"].values, analysis.observations.values)
    np.testing.assert_array_equal(loaded.observed_data["time"].values, analysis.observations.times)
    np.testing.assert_array_equal(loaded.sample_stats["centre"].values, analysis.centre)
    np.testing.assert_array_equal(loaded.iterations["J"].values, [r.cost for r in analysis.iterations])
    active = loaded.sample_stats["active"].values[0]
    assert active.dtype == bool
    assert np.flatnonzero(~active).tolist() == [FAILED]
    assert loaded.sample_stats["failure_reason"].values[0, FAILED] == "collapse too violent"
    assert loaded.name == analysis.name
    assert loaded.warnings == analysis.warnings


def test_scalars_of_the_fit(path, analysis):
    stats = load_result(path).sample_stats.attrs
    y = analysis.observations.values
    mean = np.nanmean(analysis.posterior_predictions, axis=0)
    expected = 1 - np.sqrt(np.sum((y - mean) ** 2) / np.sum((y - y.mean()) ** 2))
    assert stats["nrmse"] == pytest.approx(expected, rel=1e-12)
    assert stats["n_active"] == 23
    assert stats["converged"] == 1
    assert stats["stop_reason"] == analysis.stop_reason
    assert stats["chi2_per_observation"] == analysis.iterations[-1].chi2_per_observation


def test_summary_is_in_display_units_and_ignores_failed_members(path, analysis):
    row = load_result(path).rows[0]
    alive = np.delete(analysis.posterior[:, 0], FAILED) / 1e3
    assert (row.name, row.unit) == ("G", "kPa")
    assert row.mean == pytest.approx(alive.mean(), rel=1e-12)
    assert row.std == pytest.approx(alive.std(ddof=1), rel=1e-12)
    assert row.q05 == pytest.approx(member_quantiles(alive, 0.05), rel=1e-12)
    assert row.centre == pytest.approx(analysis.centre[0] / 1e3, rel=1e-12)
    assert row.prior_std == pytest.approx(analysis.prior[:, 0].std(ddof=1) / 1e3, rel=1e-12)


def test_dataframe_is_one_row_a_member(result, analysis):
    frame = result.to_dataframe()
    assert list(frame.columns) == ["G", "mu", "R0", "t_s"]
    np.testing.assert_array_equal(frame.to_numpy(), analysis.posterior)


def test_the_history_holds_no_folders_of_the_machine():
    command = "en4dvar run /home/me/gel.yaml --out '/home/me/my runs/gel'"
    assert provenance("", command=command)["history"].split("Z ")[1].startswith("en4dvar run gel.yaml --out 'gel' (")


def test_two_saves_hold_the_same_bits(result, analysis, tmp_path):
    first = load_result(result.save(tmp_path / "a.nc"))
    again = Result.from_analysis(analysis, provenance("other text"))
    second = load_result(again.save(tmp_path / "b.nc"))
    for node in first.tree.subtree:
        twin = second.tree[node.path]
        for name, variable in {**node.data_vars, **node.coords}.items():
            a, b = variable.values, twin[name].values
            assert a.dtype == b.dtype
            assert a.tolist() == b.tolist() if a.dtype == object else a.tobytes() == b.tobytes()


def test_the_fit_is_that_of_readings_that_count(analysis):
    """One of weight 0 that is far off is as if it were not there."""
    o, far = analysis.observations, np.arange(len(analysis.observations)) == 2
    left_out = replace(o, values=np.where(far, 1e3 * o.values, o.values), weights=np.where(far, 0.0, o.weights))
    of_it = replace(analysis, problem=replace(analysis.problem, observations=left_out))
    y, mean = o.values[~far], np.nanmean(analysis.posterior_predictions, axis=0)[~far]
    expected = 1 - np.sqrt(np.sum((y - mean) ** 2) / np.sum((y - y.mean()) ** 2))
    assert Result.from_analysis(of_it, {}).groups["/sample_stats"].attrs["nrmse"] == pytest.approx(expected, rel=1e-12)


def test_arviz_reads_it(path):
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="\nArviZ is undergoing", category=FutureWarning)
        warnings.filterwarnings("ignore", message="iterations group is not defined", category=UserWarning)
        import arviz as az

        data = az.from_netcdf(str(path)).load()
        data.close()  # what is collected later may be closed by another thread while HDF5 is at work
    posterior = data["posterior"]
    assert posterior["G"].dims == ("chain", "draw")
    assert bool(data["sample_stats"]["active"].values[0, 0])
    assert data["observed_data"]["R"].shape == (40,)
    assert list(data["observed_data"].data_vars) == list(data["log_likelihood"].data_vars) == ["R"]
    if not az.__version__.startswith("0."):
        return  # the statistics below have other names from 1.0 on; reading is what the file answers for
    table = az.summary(posterior.dropna("draw"), kind="stats", round_to="none")
    assert list(table.index) == ["G", "mu", "R0", "t_s"]
    assert table.loc["G", "mean"] == pytest.approx(float(posterior["G"].mean()), rel=1e-12)
    alive = posterior["G"].values[np.isfinite(posterior["G"].values)]
    low, high = az.hdi(alive, hdi_prob=0.9)
    assert alive.min() <= low < alive.mean() < high <= alive.max()


def test_a_file_of_an_earlier_version_has_errors_and_paths_in_the_same_groups(result, path, tmp_path):
    groups = {name: one for name, one in result.groups.items() if name not in BESIDE.values()}
    groups |= {group: result.group(group[1:]) for group in BESIDE}
    earlier = load_result(Result(groups).save(tmp_path / "earlier.nc"))
    for group in BESIDE:
        xr.testing.assert_identical(earlier.dataset(group[1:]), load_result(path).dataset(group[1:]))
    ours, theirs = load_result(path).observations(), earlier.observations()
    np.testing.assert_array_equal(theirs.std, ours.std)
    np.testing.assert_array_equal(theirs.weights, ours.weights)


@pytest.mark.filterwarnings("ignore")  # of ArviZ, about what it will be and the few members
@pytest.mark.slow
def test_arviz_draws_it_without_arguments(make_analysis, tmp_path):
    """Wherever every member lives, and there are 25; ``plot_loo_pit`` of ArviZ 0 wants the name of the observable, and
    that is all.
    """
    az = pytest.importorskip("arviz")
    living = Result.from_analysis(make_analysis(n_members=48), {}).tree.isel(
        draw=slice(FAILED + 1, None), missing_dims="ignore"
    )
    living.to_netcdf(tmp_path / "living.nc")
    earlier = az.__version__.startswith("0.")
    with closing(az.from_netcdf(str(tmp_path / "living.nc"))) as data:
        (az.plot_ppc if earlier else az.plot_ppc_dist)(data)
        az.plot_loo_pit(data, **({"y": "R"} if earlier else {}))
        assert list(az.summary(data).index) == ["G", "mu", "R0", "t_s"]


def test_root_attributes(path):
    with netCDF4.Dataset(path) as file:
        for key in ("Conventions", "title", "history", "institution", "source", "references", "date_created"):
            assert key in file.ncattrs()
        assert file.Conventions == "CF-1.11 ACDD-1.3"
        assert file.configuration == "prior: {G: 1 kPa}\n"
        assert file.seed == 11
        assert "numpy" in file.package_versions
        assert file.dataset == "A_E2_synthetic"


def test_attributes_of_any_kind_are_storable(analysis, tmp_path):
    odd = {"flag": True, "nothing": None, "where": Path("x"), "empty": "", "number": 1.5}
    loaded = load_result(Result.from_analysis(analysis, odd).save(tmp_path / "p.nc"))
    assert {k: loaded.attributes[k] for k in odd} == {
        "flag": 1,
        "nothing": "",
        "where": "x",
        "empty": "",
        "number": 1.5,
    }


def test_all_members_failed_is_stored_with_nan_statistics(make_analysis, tmp_path):
    base = make_analysis()
    dead = make_analysis(
        posterior=np.full_like(base.posterior, np.nan),
        posterior_predictions=np.full_like(base.posterior_predictions, np.nan),
        posterior_failures=("dead",) * len(base.posterior),
    )
    loaded = load_result(Result.from_analysis(dead, {}).save(tmp_path / "p.nc"))
    assert np.isnan(loaded.sample_stats.attrs["nrmse"])
    assert np.isnan(loaded.rows[0].mean)


def test_failing_write_leaves_the_old_file_and_nothing_else(result, tmp_path, monkeypatch):
    path = result.save(tmp_path / "posterior.nc")
    before = path.read_bytes()

    def dies(target, content):
        with target.open("wb") as file:
            file.write(content[: len(content) // 2])
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", dies)
    with pytest.raises(OutputError, match="No space left"):
        result.save(path)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["posterior.nc"]


def test_unwritable_place_is_one_clear_error(result, tmp_path):
    with pytest.raises(OutputError, match=r"cannot be written: No such file or directory"):
        result.save(tmp_path / "missing" / "posterior.nc")


@pytest.mark.parametrize("content", [None, b"not netcdf"])
def test_unreadable_file_is_one_clear_error(tmp_path, content):
    path = tmp_path / "posterior.nc"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(OutputError, match=r"no such file|not a complete result of en4dvar"):
        load_result(path)


def test_foreign_netcdf_is_refused(tmp_path):
    path = tmp_path / "x.nc"
    xr.Dataset({"x": ("t", [1.0])}).to_netcdf(path)
    with pytest.raises(OutputError, match="not a complete result of en4dvar"):
        load_result(path)
    SealedBytes.of(path.read_bytes()).write(path)
    with pytest.raises(OutputError, match="not a result of en4dvar: no group prior"):
        load_result(path)


def test_untracked_file_has_no_commit(tmp_path):
    (tmp_path / "x.yaml").write_text("")
    assert git_commit(tmp_path / "x.yaml") == ""
    assert git_commit(tmp_path / "absent.yaml") == ""
