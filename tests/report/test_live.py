"""What is read from the log of a run, against its result files."""

from __future__ import annotations

import numpy as np
import pytest
from run_files import configuration, make_campaign

from en4dvar.report.live import bands, standings
from en4dvar.report.text import shown
from en4dvar.runs.runner import run_campaign


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Results of three data sets by one worker and by two, with their logs."""
    found = {}
    for executor, workers in (("serial", 1), ("threads", 2)):
        folder = tmp_path_factory.mktemp(executor)
        path = make_campaign(folder, 3)
        campaign = run_campaign(configuration(path, folder / "run", executor=executor, workers=workers))
        found[executor] = list(campaign), (folder / "run" / "run.log").read_text(encoding="utf-8")
    return found


def test_bands_are_the_quantiles_of_the_iterations(runs):
    results, log = runs["serial"]
    told = standings(log)
    assert [*told] == [result.name for result in results]
    for result in results:
        standing, held = told[result.name], result.iterations
        assert [name for name, _ in standing.bands] == [row.name for row in result.rows]
        for row in result.rows:
            band = standing.bands[row.name, row.unit]
            assert [*band] == [*range(held.sizes["iteration"])]
            expected = np.quantile(shown(held[row.name]), (0.05, 0.5, 0.95), axis=1).T
            assert np.allclose([*band.values()], expected, rtol=1e-3)
        chart = bands(standing)
        panels = [panel for line in chart.rows for panel in line.panels if not panel.bare]
        assert len(panels) == len(result.rows)


@pytest.mark.parametrize("executor", ["serial", "threads"])
def test_data_sets_stand_where_they_ended_with_their_estimates(runs, executor):
    results, log = runs[executor]
    told = standings(log)
    assert {*told} == {result.name for result in results}
    for result in results:
        assert told[result.name].at == "converged"
        words = told[result.name].estimate.split()
        row = result.rows[0]
        assert words[0] == row.name
        assert float(words[1]) == pytest.approx(row.mean, abs=row.std)


def test_the_log_of_a_run_at_work_says_how_far_it_is(runs):
    lines = runs["serial"][1].splitlines()
    middle = next(n for n, line in enumerate(lines) if "set1: iteration  1  J" in line)
    half = standings("\n".join(lines[: middle + 2]))
    assert half["set0"].at == "converged"
    assert (half["set1"].at, half["set1"].estimate) == ("iteration 1", "")
    assert "set2" not in half
    assert {step for band in half["set1"].bands.values() for step in band} == {0, 1}
    assert standings("2026-11-25T04:19:09+00:00 done\n: x\n") == {}
    failed = standings("t a: b: iteration  2  J 1\nt a: b: failed: no member lives: F\n")["a: b"]
    assert (failed.at, failed.estimate) == ("failed", "no member lives: F")


def test_a_descent_that_is_told_after_another_takes_its_place():
    lines = [f"t a: iteration {k:2d}  90 %: G {k + 5 * n} (1 to 9) kPa" for n in (0, 1) for k in range(4 - 2 * n)]
    band = standings("\n".join(lines))["a"].bands["G", "kPa"]
    assert {step: middle for step, (_, middle, _) in band.items()} == {0: 5.0, 1: 6.0}
