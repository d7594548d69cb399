"""Models side by side: probabilities from evidences, sums over data sets, and what may not be compared."""

import csv
import json
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner
from run_files import add_to_pack
from toys import Vectorised, make_problem

from en4dvar.cli import main
from en4dvar.diagnosis.diagnostics import member_quantiles
from en4dvar.estimation.assimilate import assimilate
from en4dvar.plumbing.errors import OutputError
from en4dvar.priors.prior import Prior, PriorTerm
from en4dvar.problem import InverseProblem
from en4dvar.report.compare import (
    ALL,
    Comparison,
    ModelScore,
    compare_runs,
    comparison_table,
    overlay,
    preferred,
    ranked,
    with_evidences,
    write_comparison,
)
from en4dvar.report.result import Result
from en4dvar.results.store import load_stored
from en4dvar.schemes.settings import AssimilationSettings


def run_dir(path, names, seeds=(1,), std=0.1, wide=1.0):
    """Results of linear models with the first ``names`` of a, b; the data are those of y = a alone."""
    for seed in seeds:
        problem = make_problem(Vectorised(("a",)), [1.0], seed=seed, std=std)
        model = Vectorised(names)
        observations = replace(problem.observations, name=f"set{seed}")
        prior = Prior(tuple(PriorTerm.normal(p, 0.0, wide) for p in model.parameters))
        analysis = assimilate(InverseProblem(model, problem.observable, observations, prior), AssimilationSettings(), 1)
        path.mkdir(parents=True, exist_ok=True)
        result = Result.from_analysis(analysis, {"configuration": json.dumps({})})
        add_to_pack(path, f"set{seed}", result) if len(seeds) > 1 else result.save(path / "posterior.nc")
    return path


def exact_evidence(problem_seed, names, std=0.1, wide=1.0):
    """ln N(y; 0, H B Hᵀ + R) of the linear model."""
    problem = make_problem(Vectorised(("a",)), [1.0], seed=problem_seed, std=std)
    y, t = problem.observations.values, problem.observations.times
    model = Vectorised(names)
    h = np.array([[model.curve(e, s) for e in np.eye(len(names))] for s in t])
    cov = wide**2 * h @ h.T + std**2 * np.eye(len(y))
    return float(-0.5 * (y @ np.linalg.solve(cov, y) + np.linalg.slogdet(2 * np.pi * cov)[1]))


def test_probabilities_follow_the_exact_evidence_of_linear_models(tmp_path):
    runs = [run_dir(tmp_path / "one", ("a",), (1, 2)), run_dir(tmp_path / "two", ("a", "b"), (1, 2))]
    comparison = compare_runs(runs)
    assert comparison.datasets == ("set1", "set2", ALL)
    exact = {s: [exact_evidence(s, names) for names in (("a",), ("a", "b"))] for s in (1, 2)}
    exact_sum = np.sum([exact[1], exact[2]], axis=0)
    for dataset, evidence in (("set1", exact[1]), ("set2", exact[2]), (ALL, exact_sum)):
        scores = comparison.of(dataset)
        assert [s.run for s in scores] == ["one", "two"]
        assert [s.log_evidence for s in scores] == pytest.approx(list(evidence), abs=1e-6)
        odds = np.exp(evidence[0] - evidence[1])
        assert scores[0].probability == pytest.approx(odds / (1 + odds), abs=1e-6)
        assert sum(s.probability for s in scores) == pytest.approx(1)
        assert comparison.verdict(dataset).startswith("one is preferred")
    assert comparison.of("set1")[0].dfs == pytest.approx(1, abs=0.01)
    assert comparison.of("set1")[1].dfs == pytest.approx(2, abs=0.01)


def test_other_evidences_are_judged_as_those_of_the_results(tmp_path):
    runs = [run_dir(tmp_path / "one", ("a",), (1, 2)), run_dir(tmp_path / "two", ("a", "b"), (1, 2))]
    comparison = compare_runs(runs)
    assert with_evidences(comparison, [{}, {}]) == comparison
    better = with_evidences(comparison, [{}, {"set2": 1e3}])
    assert [s.stored for s in better.scores] == [True, True, True, False, True, True]
    assert better.of("set1") == comparison.of("set1")
    assert [s.probability for s in better.of(ALL)] == [0, 1]
    assert better.of(ALL)[1].log_evidence == comparison.of("set1")[1].log_evidence + 1e3


def test_no_minus_stands_before_a_difference_of_zero():
    assert preferred("a", "b", -0.0) == "undecidable: a and b differ by 0.00 in log-evidence"


def test_equal_models_are_undecidable_on_the_command_line(tmp_path):
    runs = [str(run_dir(tmp_path / name, ("a",), wide=wide)) for name, wide in (("first", 1.0), ("second", 1.1))]
    done = CliRunner().invoke(main, ["compare", *runs, "--no-report"])
    assert done.exit_code == 0, done.output
    assert "undecidable: first and second differ by 0." in done.output
    assert done.stdout.splitlines()[0].split()[:3] == ["parameter", "unit", "data"]
    assert "do not record a configuration" in done.stderr
    assert "* as the result has it" in done.stdout
    assert comparison_table(compare_runs(runs)) in done.output


def test_no_probability_is_told_of_the_only_evidence_that_is_known():
    """The one of two models whose evidence is known had the probability 1."""
    scores = [ModelScore(run, "gel", e, np.nan, np.nan, 1.0, 2.0, 0.9) for run, e in (("a", np.nan), ("b", 2.0))]
    comparison = Comparison(tuple(ranked(scores)))
    assert np.isnan([score.probability for score in comparison.scores]).all()
    assert comparison.verdict("gel") == "not compared: the evidence of a is not known before its warnings are settled"


@pytest.mark.slow
def test_evidences_of_different_data_are_not_compared(tmp_path):
    one = run_dir(tmp_path / "one", ("a",))
    for other, message in (
        (run_dir(tmp_path / "noise", ("a",), std=0.2), "the runs noise and one used different observations of set1"),
        (run_dir(tmp_path / "sets", ("a",), (1, 2)), "the runs sets and one hold different data sets: set2"),
    ):
        comparison = compare_runs([one, other])
        assert message in comparison.incomparable
        assert comparison.verdict("set1") == f"not compared: {comparison.incomparable}"
        assert all(np.isnan(score.probability) and np.isnan(score.difference) for score in comparison.scores)
        assert {e.run for e in comparison.estimates} == {"one", other.name}
        done = CliRunner().invoke(main, ["compare", str(one), str(other), "--no-report"])
        assert done.exit_code == 0, done.output
        assert f"not compared: {message}" in done.output
        assert " *" in done.output
        assert "* as the result has it" in done.output
    page = write_comparison(comparison, tmp_path / "page").read_text(encoding="utf-8")
    assert "<p>The runs sets and one hold different data sets: set2.</p>" in page


def test_what_cannot_be_compared_is_refused(tmp_path):
    one = run_dir(tmp_path / "one", ("a",))
    for runs, message in (
        ([one, one], "given twice"),
        ([one], "at least two"),
        ([one, tmp_path / "nowhere"], "nowhere: no such file or directory"),
        ([load_stored(next(one.rglob("*.nc")))] * 2, "have no names"),
    ):
        with pytest.raises(OutputError, match=message):
            compare_runs(runs)


def test_page_figure_and_tables(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    runs = [run_dir(tmp_path / name, names, (1, 2)) for name, names in (("one", ("a",)), ("two", ("a", "b")))]
    done = CliRunner().invoke(main, ["compare", *map(str, runs)])
    assert done.exit_code == 0, done.output
    assert done.output.splitlines()[-1] == "report: compare_one_two/compare.html"
    out = tmp_path / "compare_one_two"
    assert {p.name for p in out.iterdir()} == {
        "compare.html", "posteriors.png", "posteriors.pdf", "estimates.csv", "evidence.csv",
    }  # fmt: skip
    comparison = compare_runs(runs)
    page = (out / "compare.html").read_text(encoding="utf-8")
    assert comparison.verdict(ALL) in page
    tables = page.partition("<h2>Posteriors</h2>")[2]
    assert tables.count("<tr>") == 2 + len(comparison.estimates) + len(comparison.scores)
    assert "http" not in page.replace("http-equiv", "")
    with (out / "estimates.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [(r["run"], r["dataset"], r["name"]) for r in rows] == [
        ("one", "set1", "a"), ("two", "set1", "a"), ("one", "set2", "a"), ("two", "set2", "a"),
        ("two", "set1", "b"), ("two", "set2", "b"),
    ]  # fmt: skip
    for row, estimate in zip(rows, (e for n in "ab" for e in comparison.estimates if e.summary.name == n), strict=True):
        assert float(row["mean"]) == pytest.approx(estimate.members.mean(), rel=1e-12)
    with (out / "evidence.csv").open(encoding="utf-8") as file:
        assert [float(r["log_evidence"]) for r in csv.DictReader(file)] == [s.log_evidence for s in comparison.scores]
    (row,) = overlay(comparison).rows
    assert [panel.xlabel for panel in row.panels] == ["a (m)", "b (m)"]
    assert row.panels[0].entries() == ["one", "two"]
    bars = next(mark.x for mark in row.panels[0].marks if mark.size == 2.0)
    pooled = np.concatenate([e.members for e in comparison.estimates if (e.run, e.summary.name) == ("one", "a")])
    assert list(bars) == pytest.approx(list(member_quantiles(pooled, (0.05, 0.95))))
    again = CliRunner().invoke(main, ["compare", *map(str, runs), "--out", str(out), "--no-report"])
    assert "report" not in again.output


def test_a_comparison_prints_its_table_and_plots_a_panel_a_parameter(tmp_path):
    comparison = compare_runs([run_dir(tmp_path / "one", ("a",)), run_dir(tmp_path / "two", ("a", "b"))])
    assert str(comparison) == comparison_table(comparison)
    assert len(comparison.plot().axes) == len(comparison.parameters) == 2


def test_the_warnings_for_which_a_verdict_is_doubted_are_listed_with_commas(tmp_path):
    comparison = compare_runs([run_dir(tmp_path / "one", ("a",)), run_dir(tmp_path / "two", ("a", "b"))])
    doubted = tuple(replace(score, doubted="non-gaussian at-bound") for score in comparison.scores)
    assert "one (non-gaussian, at-bound)" in replace(comparison, scores=doubted).verdict("set1")


def test_runs_of_fields_alone_are_compared_by_their_evidence(tmp_path):
    """Two priors of a field: the command ended with a traceback, for there is no panel."""
    scores = tuple(ModelScore(run, "heads", e, np.nan, np.nan, 1.0, 9.0, 0.9) for run, e in (("a", 1.0), ("b", 4.0)))
    page = write_comparison(Comparison(tuple(ranked(scores))), tmp_path).read_text(encoding="utf-8")
    assert "b is preferred" in page
    assert "<h2>Posteriors" not in page
    with pytest.raises(OutputError, match="no parameter was estimated, only fields"):
        Comparison(scores).plot()
