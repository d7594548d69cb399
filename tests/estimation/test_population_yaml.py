"""``population:`` in a configuration: single estimates and then the population behind them, in one run."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from execution_models import Stops
from run_files import assert_same_results, configuration, interrupt, make_campaign

from en4dvar.cli import main
from en4dvar.estimation.population import Effort
from en4dvar.plumbing.caution import caution
from en4dvar.plumbing.errors import ConfigError
from en4dvar.results.together import StoredGroups, load_population
from en4dvar.runs.checks import validate
from en4dvar.runs.engine import write_report
from en4dvar.runs.runner import run_campaign
from en4dvar.runs.together import population

SMALL = Effort(hyper_walkers=16, hyper_rounds=30, hyper_components=2, draws=400)
ASKED = "population: {of: [k], mean_std: 2, spread: 0.7, reference: {k: 1.9 ± 0.1 N/m, source: balance}}\n"


@pytest.fixture(autouse=True, scope="module")
def _small():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("en4dvar.estimation.population.campaign.Effort", lambda: SMALL)
        yield


def springs(folder, asked=ASKED, n=4, model="toy_models:Oscillator"):
    """Oscillators whose springs differ."""
    path = make_campaign(folder, n, model)
    path.write_text(path.read_text() + asked)
    return path


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A run with a population, and what it printed."""
    folder = tmp_path_factory.mktemp("springs")
    path, run = springs(folder), folder / "run"
    result = CliRunner().invoke(main, ["run", str(path), "--out", str(run), "--no-report"])
    assert result.exit_code == 0, result.output
    return run, result.output


@pytest.mark.slow
def test_a_run_ends_with_its_population(finished):
    run, output = finished
    assert "mean of the population" in output
    within = load_population(run / "population.nc")
    assert within.attributes["hyperprior_mean_std"] == 2.0
    assert 1.5 < np.quantile(within.group("posterior")["k_mean"].values, 0.5) < 2.2  # the springs are 1.6 to 2.05


@pytest.mark.slow
def test_it_is_what_the_command_says_and_has_a_page(finished, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(finished[0], run)
    within = load_population(run / "population.nc")
    after, _ = population([run], ["k"], tmp_path / "after")
    for name, values in after.group("posterior").variables.items():
        assert np.array_equal(values.values, within.group("posterior")[name].values), name
    asked = CliRunner().invoke(
        main, ["population", str(run), "--of", "k", "--spread", "0.3", "--out", str(tmp_path / "o")]
    )
    assert asked.exit_code == 0, asked.output
    attributes = load_population(tmp_path / "o" / "population.nc").attributes
    assert (attributes["hyperprior_mean_std"], attributes["hyperprior_spread"]) == (
        2.0,
        0.3,
    )  # as asked, else the run's
    write_report(run)
    page = (run / "report.html").read_text()
    assert page.index("<h1>") < page.index("the median (geometric mean) of the population") < page.index("<svg")
    assert page.index("Reference: k = 1.90 ± 0.10 N/m, balance") < page.index("Each data set by itself")
    assert 'href="population.html"' in page
    warned = re.search("posteriors come with|No warnings in any", page).start()
    assert page.index("balance") < warned < page.index("<svg")
    folded = page.index("<summary>The other parameters of each data set")
    assert page.index('id="estimates"') < folded < page.index('id="others"') < page.index("<h2>Data sets</h2>")
    assert within.reference == {"k": (1.9, 0.1)}
    listed = (run / ".en4dvar-files").read_text()
    assert all(name in listed for name in ("population.nc", "population.html", "population.csv", "population.tex"))


@pytest.mark.slow
def test_warnings_of_the_population_are_on_the_page_of_the_run(finished, tmp_path, monkeypatch):
    run = tmp_path / "run"
    shutil.copytree(finished[0], run)
    few = caution("chain-not-converged", "only 8 effective draws support the population")
    monkeypatch.setattr(StoredGroups, "cautions", (few,))
    write_report(run)
    page = (run / "report.html").read_text()
    assert page.index("The population of all data sets: warnings") < page.index(few.words) < page.index("<svg")
    assert "<code>chain-not-converged</code>" in page


@pytest.mark.slow
def test_killed_and_resumed_to_the_same_bits(tmp_path, monkeypatch):
    monkeypatch.setattr(Stops, "calls", 0)  # whatever ran before
    path = springs(tmp_path, model="execution_models:Stops")
    whole = run_campaign(configuration(path, tmp_path / "whole"))
    told = interrupt(path, tmp_path / "cut", Stops.calls - 3)  # in the midst of the population's forward runs
    assert "4 of 4 data sets are done" in told
    assert not (tmp_path / "cut" / "population.nc").exists()
    run_campaign(configuration(path, tmp_path / "cut"), resume=True)
    assert_same_results(whole.directory, tmp_path / "cut")


def test_data_sets_without_a_population_are_reported_alone(tmp_path, monkeypatch):
    def none(*_, **__):
        raise ValueError("none of the populations that were drawn explains the data")

    monkeypatch.setattr("en4dvar.runs.together.population_of", none)
    result = CliRunner().invoke(main, ["run", str(springs(tmp_path, n=3)), "--out", str(tmp_path / "run")])
    assert result.exit_code == 0, result.output
    assert "no population; the data sets are estimated alone: none of the populations" in result.output
    assert {"report.html", "summary.csv"} <= {path.name for path in (tmp_path / "run").iterdir()}


@pytest.mark.parametrize(
    ("n", "asked", "words"),
    [
        (3, "population: {of: [q]}\n", r"yaml:\d+:\d+: population\.of\.0: q: not estimated"),
        (3, "population: {of: [c]}\n", r"yaml:\d+:\d+: population\.of\.0: c: not estimated"),
        (3, "population: {of: [A]}\n", r"A: its prior depends on the data set"),
        (3, "population: {of: [k, k]}\n", r"population of k, k: name each parameter once"),
        (3, "population: {of: []}\n", r"yaml:\d+:\d+: population\.of: "),
        (3, "population: {of: [k], reference: {q: 2 N/m}}\n", r"yaml:\d+:\d+: population\.reference\.q: 'q': neither"),
        (3, "population: {of: [k], reference: {k: 2 ± -1 N/m}}\n", r"population\.reference\.k: .* unit '± -1 N/m'"),
        (3, "population: {of: [k], reference: {k: 2 ± 1 s}}\n", r"yaml:\d+:\d+: population\.reference\.k: '2 s'"),
        (3, "population: {of: [k], reference: {k: soft}}\n", r"population\.reference\.k: 'soft' is no value such as"),
        (3, "population: {of: [k], spread: 0}\n", r"yaml:\d+:\d+: population\.spread: "),
        (2, ASKED, r"yaml:\d+:\d+: population: .* at least 3 data sets, not 2; .*--set population=null"),
    ],
)  # fmt: skip
def test_what_has_no_population_is_told_before_anything_is_computed(tmp_path, n, asked, words):
    path = springs(tmp_path, asked, n)
    with pytest.raises(ConfigError, match=words):
        validate(path)
    with pytest.raises(ConfigError, match=words):
        run_campaign(configuration(path, tmp_path / "run"))
    assert not (tmp_path / "run").exists()


def test_data_sets_of_several_series_have_none_which_is_told_before_anything_is_computed():
    path = Path(__file__).resolve().parents[2] / "configs" / "predator_prey.yaml"
    with pytest.raises(ConfigError, match=r"population: .* of one series each; .*--set population=null"):
        validate(path, {"population": {"of": ["alpha"]}})


@pytest.mark.slow
def test_errors_of_any_kind(tmp_path):
    """A discrepancy whose amplitude and length are quantities of each data set."""
    path = springs(tmp_path)
    text = path.read_text().replace("position_std: 2 um", "position_std: 2 um, discrepancy: estimated")
    assert "discrepancy" in text
    path.write_text(text)
    run = run_campaign(configuration(path, tmp_path / "run")).directory
    stored = load_population(run / "population.nc")
    assert 1.4 < np.quantile(stored.group("posterior")["k_mean"].values, 0.5) < 2.4
    assert set(stored.belongs) == {"set0", "set1", "set2", "set3"}
    low, middle, high = stored.group("empirical")["k"].values
    assert low < middle < high
