"""Campaigns: what fails is named and ends nothing; one file for all; names that every file system takes."""

import csv
import re
import shutil

import netCDF4
import numpy as np
import pytest
import xarray as xr
from run_files import configuration, make_campaign, run_cli
from toy_config import csv_text

from en4dvar.commands.common import Failed
from en4dvar.commands.run import _tell
from en4dvar.config import load_config
from en4dvar.plumbing.errors import DataError, OutputError, TooFewMembersError
from en4dvar.report.result import load_result
from en4dvar.results.campaign_file import GROUPS, save_campaign
from en4dvar.results.pack import PACK, Pack, file_names, read_outcome, results_of
from en4dvar.runs import campaign as campaigns
from en4dvar.runs.campaign import Campaign, DatasetOutcome, Outcomes
from en4dvar.runs.engine import write_report
from en4dvar.runs.runner import run_campaign


@pytest.fixture(scope="module")
def campaign(tmp_path_factory):
    """Six data sets: three good ones of different length, one empty file, one that loses its ensemble, one not text."""
    folder = tmp_path_factory.mktemp("campaign")
    path = make_campaign(folder, 4, "execution_models:Breaks", large=2)
    (folder / "data" / "set1.csv").write_text(csv_text(25, k=1.8))
    (folder / "data" / "empty.csv").write_text("t_ms,x_um\n")
    (folder / "data" / "image.csv").write_bytes(bytes(range(256)) * 4)
    return run_campaign(configuration(path, folder / "run"))


def test_failures_are_named_and_the_rest_is_estimated(campaign):
    assert [o.name for o in campaign.outcomes] == ["empty", "image", "set0", "set1", "set2", "set3"]
    assert [o.name for o in campaign.failures] == ["empty", "image", "set2"]
    assert [o.exit_code for o in campaign.failures] == [DataError.exit_code] * 2 + [TooFewMembersError.exit_code]
    assert "empty.csv: " in campaign.failures[0].failure
    assert "ArithmeticError: too large" in campaign.failures[2].failure
    assert campaign.exit_code == 1
    assert [r.name for r in campaign] == ["set0", "set1", "set3"]
    assert campaign["set3"].name == "set3"
    with pytest.raises(KeyError):
        campaign["empty"]
    log = (campaign.directory / "run.log").read_text()
    rows = list(csv.DictReader((campaign.directory / "summary.csv").read_text().splitlines()))
    for outcome in campaign.failures:
        assert f"{outcome.name}: failed: {outcome.failure.splitlines()[0]}" in log
        assert [r["failure"] for r in rows if r["dataset"] == outcome.name] == [outcome.failure]
    assert {r["dataset"]: r["name"] for r in rows if not r["failure"]} == dict.fromkeys(["set0", "set1", "set3"], "k")
    assert [p.name for p in results_of(campaign.directory / PACK)] == ["set0", "set1", "set3"]


def test_several_series_of_different_length_lie_side_by_side_with_their_times(tmp_path):
    """Two cameras; what the second one saw of the second oscillation is longer than what either saw of the first."""
    columns = {"time": {"name": "t_ms", "unit": "ms"}, "position": {"name": "x_um", "unit": "um"}}
    of_all = {"observable": "position", "columns": columns, "error": {"position_std": "2 um"}}
    lengths = {"left": (9, 7), "right": (8, 11)}
    for camera, counts in lengths.items():
        (tmp_path / camera).mkdir()
        for name, count in zip("ab", counts, strict=True):
            (tmp_path / camera / f"{name}.csv").write_text(csv_text(count))
    asked = {
        "name": "two",
        "data": {"series": {camera: {**of_all, "path": str(tmp_path / camera)} for camera in lengths}},
        "model": {"name": "toy_models:Oscillator", "mass": "2 g"},
        "parameters": {
            "A": "100 um",
            "c": "0.02 N s/m",
            "k": {"prior": "lognormal", "median": "3 N/m", "log_std": 0.3},
        },
        "assimilation": {"members": 3, "max_iterations": 1, "what_if": False, "refine": "none"},
        "output": {"report": False, "directory": str(tmp_path / "run")},
    }
    assert run_campaign(load_config(asked)).exit_code == 0
    with netCDF4.Dataset(tmp_path / "run" / "posterior.nc") as file:
        file.set_auto_mask(False)
        observed, predicted = file["observed_data"], file["posterior_predictive"]
        assert predicted["right"].dimensions == ("dataset", "chain", "draw", "right_observation")
        for camera, counts in lengths.items():
            times = [
                np.where(np.arange(max(counts)) < count, 5e-3 * np.arange(max(counts)), np.nan) for count in counts
            ]
            np.testing.assert_allclose(observed[f"{camera}_time"][:], times)
            np.testing.assert_array_equal(np.isnan(observed[camera][:]), np.isnan(times))


@pytest.mark.parametrize(
    ("codes", "expected"), [((0, 0), 0), ((3, 0), 3), ((3, 3), 3), ((3, 2), 1), ((2, 0), 1), ((1, 1), 1)]
)
def test_exit_code(tmp_path, codes, expected):
    outcomes = [DatasetOutcome(str(i), None, "reason" if code else "", code) for i, code in enumerate(codes)]
    assert Campaign(tmp_path, tuple(outcomes)).exit_code == expected


def test_an_outcome_that_was_altered_is_told(campaign, tmp_path):
    shutil.copytree(campaign.directory, tmp_path / "run")
    entries, record = Pack(campaign.directory / PACK).entries, tmp_path / "run" / PACK
    record.write_bytes(record.read_bytes().replace(b'"failure": ""', b'"failure": 12'))
    with pytest.raises(OutputError, match=r"datasets\.pack/set0: damaged or altered"):
        Outcomes(tmp_path / "run", PACK, entries, {"set0": "set0"})[0]


def test_one_file_for_all(campaign):
    single = {r.name: r for r in campaign}
    with xr.open_datatree(campaign.directory / "posterior.nc") as tree:
        assert set(tree.children) == set(GROUPS)
        for group in ("prior", "posterior"):
            assert tree[group]["k"].dims == ("dataset", "chain", "draw")
            assert tree[group]["dataset"].values.tolist() == list(single)
        for name, result in single.items():
            one = {g: tree[g].to_dataset().sel(dataset=name) for g in GROUPS}
            for key in ("A", "k"):
                np.testing.assert_array_equal(one["posterior"][key], result.posterior[key])
                assert one["posterior"][key].attrs == result.posterior[key].attrs
            n = len(result.observed_data["time"])
            for group in ("observed_data", "prior_predictive", "log_likelihood"):
                ours, theirs = one[group]["position"], result.dataset(group)["position"]
                np.testing.assert_array_equal(ours[..., :n], theirs)
                assert np.isnan(ours[..., n:]).all()
            np.testing.assert_array_equal(one["observed_data"]["time"][:n], result.observed_data["time"])
            np.testing.assert_array_equal(one["sample_stats"]["active"], result.sample_stats["active"])
            assert one["sample_stats"]["nrmse"] == result.sample_stats.attrs["nrmse"]
            assert one["sample_stats"]["dfs_total"] == result.sample_stats.attrs["dfs"]
            np.testing.assert_array_equal(one["sample_stats"]["dfs"], result.sample_stats["dfs"])
            assert str(one["sample_stats"]["stop_reason"].values) == result.sample_stats.attrs["stop_reason"]
            assert one["constant_data"]["c"] == 0.02
        assert {len(r.observed_data["time"]) for r in single.values()} == {25, 31}


def test_blocks_make_no_difference(campaign, tmp_path, monkeypatch):
    pack = Pack(campaign.directory / PACK)
    sources = {load_result(address).name: address.name for address in results_of(pack.path)}
    monkeypatch.setattr("en4dvar.results.campaign_file.BLOCK", 1)
    one_by_one = xr.load_datatree(save_campaign(tmp_path / "posterior.nc", pack, sources, {}, {}))
    together = xr.load_datatree(campaign.directory / "posterior.nc")
    for group in GROUPS:
        xr.testing.assert_identical(one_by_one[group].to_dataset(), together[group].to_dataset())


def test_the_log_says_where_descents_ended(campaign):
    """And takes no search for a worker that was lost and repeats itself."""
    log = (campaign.directory / "run.log").read_text(encoding="utf-8")
    assert re.match(r"\S+ en4dvar", log)  # the time is told once
    assert log.count("descents ended at J") == len(list(campaign))
    assert "search for another minimum, round  1" in log
    assert "worker was lost" not in log


def test_correlated_errors_are_kept_beside_one_another(tmp_path):
    path = make_campaign(tmp_path, 2)
    (tmp_path / "data" / "set1.csv").write_text(csv_text(25))
    path.write_text(path.read_text().replace("position_std: 2 um", "position_std: 2 um, correlation_time: 20 ms"))
    done = run_campaign(configuration(path, tmp_path / "run"))
    with xr.open_datatree(done.directory / "posterior.nc") as tree:
        together = tree["observation_errors"]["position_decay_time"]
        assert together.dims == ("dataset", "observation")
        assert together.shape == (2, 31)
        for result in done:
            n = len(result.observed_data["time"])
            ours = together.sel(dataset=result.name).values
            np.testing.assert_array_equal(ours[:n], result.observed_data["position_decay_time"])
            assert np.isnan(ours[n:]).all()
    assert {len(result.observed_data["time"]) for result in done} == {25, 31}


@pytest.mark.filterwarnings("ignore")  # whatever ArviZ and its dependencies deprecate
def test_arviz_reads_every_group(campaign):
    import arviz  # takes seconds

    data = arviz.from_netcdf(str(campaign.directory / "posterior.nc"))
    assert set(GROUPS) <= {str(g).strip("/") for g in (data.children if hasattr(data, "children") else data.groups())}
    table = arviz.summary(data, var_names=["k"], kind="stats")
    means = [float(r.posterior["k"].mean()) for r in campaign]
    assert len(table) == 3
    assert table["mean"].astype(float).to_numpy() == pytest.approx(means, rel=1e-2)


@pytest.mark.usefixtures("one_figure")
def test_report_names_the_failures(campaign):
    html = write_report(campaign.directory).read_text()
    assert "3 data sets without a posterior" in html
    assert "ArithmeticError: too large" in html


def test_names_of_files():
    names = ["a b", "a/b", "A_B", "ü", "u\u0308", "con", "..", "x" * 300, "x" * 299 + "y", "ゲル 1", "a:b*?"]
    files = file_names(names)
    assert list(files) == names
    folded = [f.casefold() for f in files.values()]
    assert len(set(folded)) == len(names)
    assert all(0 < len(f.encode()) < 140 and not set(f) & set(' /\\:*?"<>|\0') and f[0] != "." for f in files.values())
    assert "con" not in folded
    assert [*file_names(["gel 1", "gel/1", "Gel_1", "ゲル"]).values()] == ["gel_1", "gel_1_2", "Gel_1_3", "ゲル"]


def test_unicode_blanks_and_same_names(tmp_path):
    path = make_campaign(tmp_path, 0)
    folder = tmp_path / "data"
    for place in ("run 1/ゲル 5 %", "run 2/ゲル 5 %", "x/run 1/ゲル 5 %"):
        (folder / place).parent.mkdir(parents=True)
        (folder / f"{place}.csv").write_text(csv_text())
    path.write_text(path.read_text().replace("data/*.csv", "data/**/*.csv"))
    campaign = run_campaign(configuration(path, tmp_path / "out put"))
    assert [o.name for o in campaign.outcomes] == ["run 1_ゲル 5 %", "run 2_ゲル 5 %", "run 1_ゲル 5 %_2"]
    assert [load_result(o.file).name for o in campaign.outcomes] == [o.name for o in campaign.outcomes]
    assert campaign.exit_code == 0


@pytest.mark.slow
def test_command_line(tmp_path):
    path = make_campaign(tmp_path, 2)
    (tmp_path / "data" / "bad.csv").write_text("t_ms,x_um\n0,1\n")
    done = run_cli("run", path, "--out", tmp_path / "run", "--data", tmp_path / "data", "--no-report")
    assert done.returncode == 1
    assert "1 of 3 data sets failed:\nbad: " in done.stderr
    assert "Traceback" not in done.stderr
    assert [line.split()[0] for line in done.stdout.splitlines()[1:]] == ["set0", "set0", "set1", "set1"]
    for file in (tmp_path / "data").glob("set*"):
        file.write_text("nothing")
    done = run_cli("run", path, "--out", tmp_path / "none", "--data", tmp_path / "data")
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 3
    assert not (tmp_path / "none").exists()


def test_the_closing_message_reads_each_outcome_once(campaign, monkeypatch, capsys):
    read = []

    def noted(path, name, entry):
        read.append(name)
        return read_outcome(path, name, entry)

    monkeypatch.setattr(campaigns, "read_outcome", noted)
    with pytest.raises(Failed, match=r"3 of 6 data sets failed:\nempty: .*\nimage: .*\nset2: "):
        _tell(campaign, with_report=False)
    assert read == ["empty", "image", "set0", "set1", "set2", "set3"]
    assert {line.split()[0] for line in capsys.readouterr().out.splitlines()[1:]} == {"set0", "set1", "set3"}
