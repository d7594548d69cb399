"""``shared:`` in a configuration: single estimates and then the joint one, in one run."""

from __future__ import annotations

import shutil

import numpy as np
import pytest
from click.testing import CliRunner
from execution_models import Stops
from run_files import assert_same_results, configuration, interrupt, make_campaign
from same_bits import assert_same_groups
from scipy.stats import norm
from toy_config import csv_text

from en4dvar.cli import main
from en4dvar.config import load_config
from en4dvar.plumbing.errors import ConfigError
from en4dvar.report.together import joint_lines
from en4dvar.results.together import load_joint
from en4dvar.runs.checks import check_all
from en4dvar.runs.engine import write_report
from en4dvar.runs.runner import run_campaign
from en4dvar.runs.together import join

K = "k: {prior: lognormal, median: 3 N/m, log_std: 0.3}"
SHARED = K.replace("0.3}", "0.3, shared: spring}")
GROUPS = "groups:\n  spring: {soft: 'set[01]', stiff: [set2, set3]}\n"


def springs(folder, shared=SHARED, groups=GROUPS, model="toy_models:Oscillator"):
    """Two oscillators of a soft spring and two of a stiff one."""
    folder.mkdir(exist_ok=True)
    path = make_campaign(folder, 4, model)
    path.write_text(path.read_text().replace(K, shared) + groups)
    for i in range(4):
        (folder / "data" / f"set{i}.csv").write_text(csv_text(k=2.0 if i < 2 else 3.0, nth=i))
    return path


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """The configuration of two pairs, and its run."""
    folder = tmp_path_factory.mktemp("springs")
    path = springs(folder)
    result = CliRunner().invoke(main, ["run", str(path), "--out", str(folder / "run"), "--no-report"])
    assert result.exit_code == 0, result.output
    return path, folder / "run", result.output


def test_one_value_for_each_group(finished):
    _, run, output = finished
    found = load_joint(run / "joint.nc")
    posterior = found.group("posterior")
    assert found.shared == ("k_soft", "k_stiff")
    assert abs(posterior["k_soft"].values.mean() - 2.0) < 0.05
    assert abs(posterior["k_stiff"].values.mean() - 3.0) < 0.05
    assert posterior["A"].dims == ("chain", "draw", "dataset")
    assert "k_soft" in output
    alone = found.group("alone")
    assert np.isfinite(alone["k_soft"].values[:, 1]).tolist() == [True, True, False, False]
    listed = (run / ".en4dvar-files").read_text()
    assert "joint.nc" in listed


def test_what_the_data_leave_as_stated_comes_last_and_in_one_line(finished):
    found = load_joint(finished[1] / "joint.nc")
    soft, stiff = joint_lines(found)
    low, middle, high = found.group("prior")["k_soft"].values
    draws = found.group("posterior")["k_soft"].values
    std, z = (high - low) / 3.2897, norm.ppf((np.arange(draws.size) + 0.5) / draws.size)
    draws[:] = middle + std * (z / z.std()).reshape(draws.shape)
    assert joint_lines(found) == [
        stiff, "the data add nothing to what was known before of: stiffness, soft"
    ]  # fmt: skip
    draws[:] += 0.5 * std  # the data moved it
    assert [line.split(" = ")[0] for line in joint_lines(found)] == [line.split(" = ")[0] for line in (soft, stiff)]


@pytest.mark.slow
def test_pages(finished, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(finished[1], run)
    write_report(run)
    page = (run / "report.html").read_text()
    assert 'href="joint.html"' in page
    assert page.count("each data set alone (grey) and all together. ") == 2  # as drawn, and read aloud
    assert "What they share" in (run / "joint.html").read_text()
    assert all(name in (run / ".en4dvar-files").read_text() for name in ("joint.csv", "joint.html"))


def test_the_command_says_the_same_and_writes_beside(finished):
    _, run, _ = finished
    result = CliRunner().invoke(main, ["joint", str(run)])
    assert result.exit_code == 0, result.output
    found = load_joint(run.parent / "joint_run" / "joint.nc")
    assert_same_groups(found.groups, load_joint(run / "joint.nc").groups, "/posterior")


def test_killed_in_the_joint_estimate_it_ends_with_the_same_bits(tmp_path):
    path = springs(tmp_path / "a", model="execution_models:Stops")
    Stops.calls = Stops.stop_at = 0
    run_campaign(configuration(path, tmp_path / "whole"))
    calls = Stops.calls
    told = interrupt(path, tmp_path / "cut", calls - 30)
    assert "4 of 4 data sets are done" in told
    assert not (tmp_path / "cut" / "joint.nc").exists()
    Stops.calls = 0
    run_campaign(configuration(path, tmp_path / "cut"), resume=True)
    assert Stops.calls <= 31  # neither are the single estimates made again, nor what the joint one had run
    assert not list((tmp_path / "cut" / "checkpoints").glob("*.iteration"))
    assert_same_results(tmp_path / "whole", tmp_path / "cut")
    Stops.calls = 0
    run_campaign(configuration(path, tmp_path / "cut"), resume=True)
    assert Stops.calls == 0


def test_the_bits_do_not_depend_on_the_workers(finished, tmp_path):
    path, run, _ = finished
    run_campaign(configuration(path, tmp_path / "two", executor="threads", workers=2))
    assert_same_results(run, tmp_path / "two")


def test_a_run_that_shares_nothing_any_more_leaves_no_joint_estimate(tmp_path):
    path = springs(tmp_path / "a")
    run_campaign(configuration(path, tmp_path / "run"))
    assert (tmp_path / "run" / "joint.nc").exists()
    path.write_text(path.read_text().replace(", shared: spring", ""))
    run_campaign(configuration(path, tmp_path / "run"), force=True)
    assert not (tmp_path / "run" / "joint.nc").exists()
    with pytest.raises(ConfigError, match="nothing is shared: give --share NAME"):
        join([tmp_path / "run"], [], tmp_path / "out")


def test_one_data_set_shares_with_nobody(tmp_path):
    path = springs(tmp_path / "a")
    data = {"data.path": str(tmp_path / "a" / "data" / "set1.csv"), "output.report": False}
    found = run_campaign(load_config(path, data | {"output.directory": str(tmp_path / "run")}))
    assert any("no joint estimate" in notice for notice in found.notices)


def test_all_share_it(tmp_path):
    path = springs(tmp_path / "a", K.replace("0.3}", "0.3, shared: all}"), "")
    run_campaign(configuration(path, tmp_path / "run"))
    assert load_joint(tmp_path / "run" / "joint.nc").shared == ("k",)


@pytest.mark.parametrize(
    ("shared", "groups", "words"),
    [
        (SHARED, GROUPS.replace("spring", "springs"), r"yaml:1\d:\d+: .*no kind of 'groups:' is called 'spring'.*spri"),
        (SHARED, GROUPS.replace(", set3", ""), r"toy\.yaml:\d+:\d+: .*data set 'set3' is in none of them"),
        (SHARED, GROUPS.replace("set2, set3", "other"), r"set2' is in none of them\n.*'set3' is in none of them"),
        (SHARED, GROUPS.replace("set2,", "set1, set2,"), r"data set 'set1' is in several of them: soft, stiff"),
        (
            "k: {prior: lognormal, median: maximum, log_std: 0.3, shared: all}".replace("maximum", "3 N/m")
            + "\n  t_s: {prior: normal, mean: 0 s, std: 1 ms, varies: {std: 1 ms, knots: 1}}",
            "",
            r"varies",
        ),
    ],
)  # fmt: skip
def test_what_cannot_be_shared_is_told_before_anything_is_computed(tmp_path, shared, groups, words):
    path = springs(tmp_path / "a", shared, groups)
    with pytest.raises(ConfigError, match=words):
        check_all(path)
    with pytest.raises(ConfigError, match=words):
        run_campaign(configuration(path, tmp_path / "run"))
    assert not (tmp_path / "run").exists()


def test_a_prior_from_the_data_cannot_be_shared(tmp_path):
    path = springs(tmp_path / "a")
    path.write_text(path.read_text().replace("mean: maximum, std: 1 %", "mean: maximum, std: 1 %, shared: all"))
    with pytest.raises(ConfigError, match=r"parameters\.A\.shared: its prior depends on the data set"):
        load_config(path)
