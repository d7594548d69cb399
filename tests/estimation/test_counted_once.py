"""Readings count once in what is estimated of several data sets together."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner
from run_files import configuration, make_campaign
from toy_config import csv_text
from toys import make_observations

from en4dvar.cli import main
from en4dvar.data.noise import noise_of
from en4dvar.data.observations import _scale, require_distinct
from en4dvar.plumbing.errors import ConfigError
from en4dvar.runs.runner import run_campaign

TWICE = "hold the same readings, which would count more than once: give each recording once"
K = "k: {prior: lognormal, median: 3 N/m, log_std: 0.3}"


def recording(name="a", part=slice(None), seed=0, digits=4, **more):
    """Twelve readings of a recording, or a part of them."""
    values = np.round(np.random.default_rng(seed).uniform(1, 9, 12), digits)
    data = make_observations(np.arange(12.0)[part], values[part], std=0.1, name=name)
    return replace(data, source=f"{name}.csv", **more)


@pytest.mark.parametrize(
    "other",
    [
        recording("b"),
        recording("b", weights=2 * np.ones(12)),  # two configurations of one recording
        recording("b", slice(5, None)),
        recording("b", slice(None, None, 2)),
        replace(recording("b"), values=recording().values * (1 + 1e-14)),  # of other units
        recording("b", scalars={"film": 3.0}),
        replace(recording("b"), values=recording().values + (np.arange(12) == 7)),  # one reading was corrected
        replace(
            recording("b"), values=recording().values.astype(np.float32).astype(float)
        ),  # an export of single precision
        recording("b", slice(0, 3)),
    ],
)
def test_one_recording_counts_once(other):
    with pytest.raises(ConfigError, match=rf"^a \(a\.csv\) and b \(b\.csv\) {TWICE}"):
        require_distinct([recording(), recording("between", seed=1), other])


@pytest.mark.parametrize(
    "other",
    [
        recording("b", seed=1),
        recording("b", seed=2, digits=0),  # on the same grid, some readings are equal by chance
        recording("b", slice(3, 4)),
        replace(recording("b"), noise=noise_of(0.1 * np.ones(12), np.zeros(12), sides=np.ones(12))),  # bounds
        replace(recording("b"), values=np.zeros(12)),
    ],
)
def test_other_readings_at_the_same_times_are_another_recording(other):
    require_distinct([recording(digits=0 if "2" in other.name else 4), replace(other, name="b")])
    require_distinct([replace(recording(), values=np.zeros(12)), replace(recording("b"), values=np.zeros(12))])


@pytest.mark.parametrize(
    ("count", "step", "sets"),
    [(4, 1.0, 50), (5, 0.5, 50), pytest.param(10, 2.0, 50, marks=pytest.mark.slow), (30, 0.5, 12), (6, 0.0, 100)],
)
def test_replicates_on_a_coarse_scale_are_recordings_of_their_own(count, step, sets):
    """Errors of 0.5 about one curve, written down in steps as large: some of them agree by chance."""
    times = np.arange(float(count))
    for seed in range(20):
        read = 20 * np.exp(-0.3 * times) + np.random.default_rng(seed).normal(0, 0.5, (sets, count))
        read = step * np.round(read / step) if step else read
        require_distinct([make_observations(times, values, std=0.5, name=f"r{i}") for i, values in enumerate(read)])


@pytest.mark.parametrize("fewer", [{"times": 2}, {"values": 1}, {"times": 1, "values": 1}])
def test_a_copy_with_fewer_digits_counts_once(fewer):
    """Frames of 0.63 us, of which two programs wrote the times and radii with other numbers of digits."""
    times = 0.63 * np.arange(40.0) + 7.1234
    values = 60 * np.exp(-times / 20) + np.random.default_rng(3).normal(0, 0.4, 40)
    first = make_observations(times, values, std=0.4, name="a")
    digits = {"times": 9, "values": 9, **fewer}
    copy = make_observations(np.round(times, digits["times"]), np.round(values, digits["values"]), std=0.4, name="b")
    for sets in ([first, copy], [copy, first], [replace(first, times=times - 7.1, zero=7.1), copy]):
        with pytest.raises(ConfigError, match=rf"^{sets[0].name} and {sets[1].name} {TWICE}"):
            require_distinct(sets)
    again = make_observations(times, values + np.random.default_rng(4).normal(0, 0.4, 40), std=0.4, name="b")
    require_distinct([first, replace(again, values=np.round(again.values, 1))])


def test_all_copies_are_named():
    many = [recording(name, seed=seed) for name, seed in (("a", 0), ("b", 1), ("c", 0), ("d", 2), ("e", 1), ("f", 0))]
    words = r"^a \(a.csv\), c \(c.csv\) and f \(f.csv\); b \(b.csv\) and e \(e.csv\) "
    with pytest.raises(ConfigError, match=words + TWICE):
        require_distinct(many)


@pytest.mark.parametrize("scale", [1.0, 0.5, 0.1, 1e-4, 3e-7])
def test_the_scale_of_readings(scale):
    counts = np.random.default_rng(1).integers(1, 90_000, 40)
    assert _scale(scale * counts * 1e-6) == pytest.approx(scale * 1e-6, rel=1e-9)
    assert _scale(recording().values) == pytest.approx(1e-4, rel=1e-9)
    assert _scale(np.zeros(3)) == np.inf


def test_rows_of_a_table_are_told_apart_by_their_other_columns():
    """Bubbles of which one time each is read."""
    row = {"R_max": 0.2, "R_eq": 0.03, "tilt": 7.0}
    a, b = (recording(name, slice(3, 4), scalars=row) for name in "ab")
    require_distinct([a, replace(b, scalars={**row, "R_max": 0.21})])
    require_distinct([a, replace(b, values=1.05 * a.values)])
    with pytest.raises(ConfigError, match=TWICE):
        require_distinct([a, b])


@pytest.fixture
def run(tmp_path):
    """Three oscillators of one spring."""
    path = make_campaign(tmp_path, n=3)
    run_campaign(configuration(path, tmp_path / "run"))
    return tmp_path / "run"


def test_a_run_given_twice_is_refused(run):
    for words in (["joint", "--share", "k"], ["population", "--of", "k"]):
        result = CliRunner().invoke(main, [*words, str(run), str(run)])
        assert result.exit_code == 2
        assert TWICE in result.output


def test_an_earlier_result_is_replaced_with_force_and_without(run):
    words = ["joint", "--share", "k", str(run)]
    for force in ([], [], ["--force"]):
        result = CliRunner().invoke(main, [*words, *force])
        assert result.exit_code == 0, result.output


@pytest.mark.parametrize("together", ["shared", "population"])
def test_a_copy_among_the_files_is_refused_before_anything_is_computed(together, tmp_path):
    path = make_campaign(tmp_path, n=3)
    text = path.read_text()
    if together == "shared":
        text = text.replace(K, K.replace("0.3}", "0.3, shared: all}"))
    else:
        text += "population: {of: [k]}\n"
    path.write_text(text)
    assert CliRunner().invoke(main, ["validate", str(path)]).exit_code == 0
    (tmp_path / "data" / "set2.csv").write_text(csv_text(k=1.6))
    for command in ("validate", "run"):
        result = CliRunner().invoke(main, [command, str(path)])
        assert result.exit_code == 2
        assert "data.path: set0" in result.output
        assert TWICE in result.output
    assert not list(tmp_path.glob("**/*.nc"))
