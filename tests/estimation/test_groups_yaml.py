"""``population: {by: KIND}``: one population a group of data sets in one run, and their comparison."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from click.testing import CliRunner
from execution_models import Stops
from run_files import assert_same_results, configuration, interrupt
from test_population_yaml import SMALL
from toy_config import csv_text, write_toy

from en4dvar.cli import main
from en4dvar.model.state import Parameter
from en4dvar.plumbing.errors import ConfigError
from en4dvar.report import populations
from en4dvar.report.populations import compare_populations, numbers_of
from en4dvar.results import together
from en4dvar.results.together import load_groups_of, load_population
from en4dvar.runs.checks import validate
from en4dvar.runs.engine import write_report
from en4dvar.runs.runner import run_campaign

ASKED = (
    "population: {of: [k], by: folder, mean_std: 2, spread: 0.7, known: {gel 8kPa: {k: 2.3 ± 0.02 N/m}}}\n"
    "groups: {folder: {gel 5kPa: 'gel 5kPa_*', gel 8kPa: 'gel 8kPa_*'}}\n"
)
SOFT, STIFF = (1.5, 1.6, 1.7), (2.2, 2.3, 2.4)


@pytest.fixture(autouse=True, scope="module")
def _small():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("en4dvar.estimation.population.campaign.Effort", lambda: SMALL)
        yield


def springs(folder, stiff=STIFF, asked=ASKED, model="toy_models:Oscillator"):
    """Springs of two kinds, of the same file names in two folders."""
    path = write_toy(folder, ("path: toy.csv", "path: data"), ("toy_models:Oscillator", model))
    for name, of_it in (("gel 5kPa", SOFT), ("gel 8kPa", stiff)):
        (folder / "data" / name).mkdir(parents=True)
        for i, k in enumerate(of_it):
            (folder / "data" / name / f"set{i}.csv").write_text(csv_text(k=k))
    path.write_text(path.read_text() + asked)
    return path


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A run with two groups and an unreadable file in the first, and what it printed."""
    folder = tmp_path_factory.mktemp("springs")
    path, run = springs(folder), folder / "run"
    (folder / "data" / "gel 5kPa" / "broken.csv").write_text("a,b\n1,2\n")
    result = CliRunner().invoke(main, ["run", str(path), "--out", str(run)])
    return run, result.output


@pytest.mark.slow
def test_each_group_is_the_population_of_its_data_sets_alone(finished, tmp_path):
    """The same files as a run of their own, whose draws differ."""
    run, _ = finished
    alone = springs(tmp_path, asked="population: {of: [k], mean_std: 2, spread: 0.7}\n")
    alone.write_text(alone.read_text().replace("path: data", "path: data/gel 8kPa"))
    by_itself = load_population(run_campaign(configuration(alone, tmp_path / "alone")).directory / "population.nc")
    for name, (folder, within) in load_groups_of(run).items():
        assert within.datasets == tuple(f"{name}_set{i}" for i in range(3))
        assert (folder / "population.html").is_file()
    x, y = within.white("k"), by_itself.white("k")
    assert abs(x.mean() - y.mean()) < 0.3 * y.std()
    medians = {n: np.median(of.group("posterior")["k_median"].values) for n, (_, of) in load_groups_of(run).items()}
    assert 1.45 < medians["gel 5kPa"] < 1.75
    assert 2.15 < medians["gel 8kPa"] < 2.45


@pytest.mark.slow
def test_terminal_and_page_open_with_the_comparison(finished, monkeypatch):
    run, output = finished
    folders = {name: folder for name, (folder, _) in load_groups_of(run).items()}
    of = compare_populations(folders, (5.0, 8.0))
    (difference,) = of.differences
    assert difference.ratio[0] < 1.6 / 2.3 < difference.ratio[2]
    page = (run / "report.html").read_text()
    answer = "k of gel 5kPa is "
    assert answer in output
    assert "broken.csv: no column" in output
    assert page.index("<h1>") < page.index(f"<li>{answer}") < page.index("Each data set by itself")  # k and not K
    assert page.index(f"<li>{answer}") < page.index('href="groups/1_gel_5kPa/population.html"')
    for text in (output, page):
        assert "k of gel 8kPa is known, 2.300 ± 0.020 N/m." in text
        assert "Nothing is common to the groups that this could calibrate." in text
    assert "straight line" not in output + page  # a line through two says no more than their difference
    assert 'href="groups/2_gel_8kPa/population.html"' in page
    assert (run / "differences.csv").is_file()
    listed = (run / ".en4dvar-files").read_text().splitlines()
    assert "groups/2_gel_8kPa/population.nc" in listed
    read, load = [], together.load_population
    monkeypatch.setattr(together, "load_population", lambda path: read.append(path) or load(path))
    monkeypatch.setattr(populations, "load_population", together.load_population)
    write_report(run)
    assert (run / "report.html").read_text() == page
    assert len(read) == 2  # each of them once


@pytest.mark.parametrize(
    ("names", "numbers"), [(["5 %", "8 %"], ()), (["5 %", "8 %", "10 %"], (5.0, 8.0, 10.0)), (["5 %", "8 %", "x"], ())]
)
def test_a_line_needs_three_groups(tmp_path, monkeypatch, names, numbers):
    monkeypatch.setattr(populations, "_whole", lambda path, of: of)
    monkeypatch.setattr(populations, "_compared", lambda groups, asked: asked)
    assert populations.groups_compared({name: (tmp_path / name, None) for name in (*names, "")}) == numbers


def test_what_a_known_group_does_to_the_others_is_told():
    """What is known and far from the group's own data is told as such; both groups' medians without and with it."""
    draws = np.linspace(7.9, 8.1, 101)
    stored = {"a": SimpleNamespace(), "ref": SimpleNamespace()}
    together, alone = (np.column_stack([5 + s * np.linspace(-1, 1, 101), draws]) for s in (0.1, 0.5))
    for of_it in stored.values():
        of_it.prior_of = lambda name: SimpleNamespace(parameter=Parameter(name, "N/m"))
    values, off = {"a": {}, "ref": {"k": (9.0, 0.1)}}, {"a": {}, "ref": {"k": 3.9}}
    told = [*populations._calibrated("k", stored, values, off, together, alone)]
    assert told[0] == "k of a is 5.000 (4.909 … 5.091) N/m, calibrated by ref; without, 5.00 (4.54 … 5.46) N/m"
    assert told[1] == "k of ref is known, 9.00 ± 0.10 N/m; its own data say otherwise, 3.9 std away"
    assert len(told) == 2
    (told_of_unit,) = populations._calibrated("k", stored, values, {"a": {}, "ref": {"k": 4.1}}, together, alone)
    assert told_of_unit.endswith("otherwise, 4.1 std away: it calibrates nothing (is its unit right?)")


@pytest.mark.slow
def test_a_group_of_one_is_told_and_the_other_has_its_number(tmp_path):
    path = springs(tmp_path, stiff=(2.3,))
    result = CliRunner().invoke(main, ["run", str(path), "--out", str(tmp_path / "run")])
    assert result.exit_code == 0, result.output
    assert "no population of gel 8kPa, for which 3 data sets need a posterior; 1 have one" in result.output
    assert list(load_groups_of(tmp_path / "run")) == ["gel 5kPa"]


@pytest.mark.slow
def test_killed_and_resumed_to_the_same_bits(tmp_path, monkeypatch):
    monkeypatch.setattr(Stops, "calls", 0)  # whatever ran before
    path = springs(tmp_path, model="execution_models:Stops")
    whole = run_campaign(configuration(path, tmp_path / "whole"))
    interrupt(path, tmp_path / "cut", Stops.calls - 3)  # in the midst of the second population
    assert list(load_groups_of(tmp_path / "cut")) == ["gel 5kPa"]
    run_campaign(configuration(path, tmp_path / "cut"), resume=True)
    assert_same_results(whole.directory, tmp_path / "cut")
    for folder in ("1_gel_5kPa", "2_gel_8kPa"):
        one, other = (load_population(tmp_path / r / "groups" / folder / "population.nc") for r in ("whole", "cut"))
        assert np.array_equal(one.white("k"), other.white("k"))


@pytest.mark.parametrize(
    ("stiff", "asked", "words"),
    [
        (STIFF, ASKED.replace("by: folder", "by: foldr"), r"population\.by: no kind of 'groups:' is called 'foldr'"),
        (STIFF, ASKED.replace("2.3 ± 0.02 N/m", "2.3 N/m"), r"gel 8kPa\.k: '2.3 N/m': how well is it known\?"),
        (STIFF, ASKED.replace("2.3 ± 0.02 N/m", "-2.3 ± 0.02 N/m"), r"gel 8kPa\.k: '-2.3 .*': beyond the bounds of k"),
        (STIFF, ASKED.replace("2.3 ± 0.02 N/m", "2.3 ± 0.02 kg"), r"population\.known\.gel 8kPa\.k: .*kg"),
        (STIFF, ASKED.replace("{k: 2.3", "{c: 2.3"), r"population\.known\.gel 8kPa\.c: 'c': not among 'of'"),
        (STIFF, ASKED.replace("known: {gel 8", "known: {gel 9"), r"known\.gel 9kPa: no such group; did you mean"),
        (STIFF, ASKED.replace("by: folder, ", ""), r"population\.known: of groups, which need 'by'"),
        (STIFF, ASKED.replace("'gel 8kPa_*'", "other"), r"groups\.folder: data set 'gel 8kPa_set0' is in none of them"),
        (STIFF, ASKED.replace("'gel 8kPa_*'", "'*'"), r"data set 'gel 5kPa_set0' is in several of them"),
    ],
)
def test_groups_that_are_wrong_are_told_before_anything_is_computed(tmp_path, stiff, asked, words):
    path = springs(tmp_path, stiff, asked)
    with pytest.raises(ConfigError, match=words):
        validate(path)
    with pytest.raises(ConfigError, match=words):
        run_campaign(configuration(path, tmp_path / "run"))
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("names", "numbers"),
    [
        (("5kPa", "8 kPa"), ((5.0, 8.0), "kPa")),
        (("gel_5.5%", "gel_8 %", "10%"), ((5.5, 8.0, 10.0), "%")),
        (("5kPa", "8 MPa"), ((), "")),
        (("day1", "day2"), ((), "")),
        (("5kPa", "stiff"), ((), "")),
        (("5kPa_a", "5kPa_b"), ((), "")),
    ],
)
def test_numbers_of_names(names, numbers):
    assert numbers_of(names) == numbers
