"""Result files, pages and repetition of a data set of several series."""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from config.test_series_section import write
from problem.series_models import all_series, problem_of

import en4dvar
from en4dvar.estimation.assimilate import assimilate
from en4dvar.plumbing.errors import ConfigError
from en4dvar.report.figures import all_figures
from en4dvar.report.history import history
from en4dvar.report.page import render_set
from en4dvar.report.responses import time_label
from en4dvar.report.result import Result, load_result
from en4dvar.results.store import load_stored
from en4dvar.runs.rerun import rerun
from en4dvar.runs.together import join
from en4dvar.schemes.settings import AssimilationSettings


@pytest.fixture(scope="module")
def analysis():
    noise = {"q": {"huber": 2.0}}
    return assimilate(problem_of(all_series(**noise)), AssimilationSettings(members=30), 1)


@pytest.fixture(scope="module")
def result(analysis, tmp_path_factory):
    path = tmp_path_factory.mktemp("series") / "posterior.nc"
    Result.from_analysis(analysis, {}).save(path)
    return load_result(path)


def test_each_series_has_its_dimension(analysis, result):
    for part in analysis.problem.parts:
        dims = ("chain", "draw", f"{part.name}_time")
        for group in ("prior_predictive", "posterior_predictive", "log_likelihood"):
            assert result.dataset(group)[part.name].dims == dims
        observed = result.observed_data[part.name]
        assert observed.dims == (f"{part.name}_time",)
        assert np.array_equal(observed.values, analysis.observations.values[part.where])
        drawn = result.dataset("posterior_predictive")[part.name].values[0]
        assert np.array_equal(drawn, analysis.posterior_predictions[:, part.where])
    assert np.array_equal(result.observed_data["f_place"].values, [0.0, 2.0, 3.5, 6.0])
    curves = result.dataset("posterior_predictive")
    assert "f_path" not in curves
    paths = np.hstack([curves["p_path"][0], curves["q_path"][0]])
    assert paths.dtype == np.float32
    np.testing.assert_allclose(paths, analysis.posterior_trajectories, rtol=2.0**-24)


def test_the_clock_of_each_series_is_kept(analysis, tmp_path):
    y, parts = analysis.observations, analysis.problem.parts
    zero = np.repeat([0.0, 3.0, 5.0], [part.end - part.begin for part in parts])
    late = replace(analysis, problem=replace(analysis.problem, observations=replace(y, zero=zero)))
    Result.from_analysis(late, {}).save(tmp_path / "posterior.nc")
    stored = load_stored(tmp_path / "posterior.nc")
    again = stored.observations({part.name: part.observable for part in parts})
    assert np.array_equal(again.file_times, y.times + zero)
    rows = history(stored).rows
    assert [row.panels[0].xlabel for row in rows[1::2]] == ["time (s)", "time since 3 s of the data (s)", "place (m)"]
    assert time_label(stored) == "time (s)"


@pytest.mark.parametrize("scale", [1e50, 1e-50])
def test_a_curve_that_single_precision_cannot_hold_is_kept_to_the_bit(analysis, scale, tmp_path):
    steep = replace(analysis, posterior_trajectories=scale * analysis.posterior_trajectories)
    Result.from_analysis(steep, {}).save(tmp_path / "posterior.nc")
    curves = load_result(tmp_path / "posterior.nc").dataset("posterior_paths")
    assert np.array_equal(np.hstack([curves["p_path"][0], curves["q_path"][0]]), steep.posterior_trajectories)


def test_the_observations_come_back_to_the_bit(analysis, result):
    observables = {part.name: part.observable for part in analysis.problem.parts}
    again, was = result.observations(observables), analysis.observations
    for key in ("times", "values", "weights", "std"):
        assert np.array_equal(getattr(again, key), getattr(was, key)), key
    assert np.array_equal(again.noise.thresholds, was.noise.thresholds)
    assert [(p.name, p.begin, p.end, p.has_path) for p in again.parts] == [
        (p.name, p.begin, p.end, p.has_path) for p in was.parts
    ]


@pytest.mark.filterwarnings("ignore:Estimated shape parameter")  # of thirty members
def test_arviz_reads_it(analysis, result, tmp_path):
    import arviz as az  # takes seconds

    result.save(tmp_path / "posterior.nc")
    with closing(az.from_netcdf(tmp_path / "posterior.nc")) as data:
        assert set(data.log_likelihood.data_vars) == {"p", "q", "f"}
        for name in ("p", "q", "f"):
            loo = az.loo(data, var_name=name, pointwise=False)
            assert np.isfinite(loo.elpd if hasattr(loo, "elpd") else loo.elpd_loo)


def test_a_panel_for_each_series(result):
    figures = {name: figure for name, _, figure in all_figures(result)}
    titles = [panel.title for row in figures["history"].rows for panel in row.panels]
    assert titles == ["p", "", "q", "", "f", ""]
    page = render_set(result)
    assert "18 observations, weights sum to 16" not in page
    assert "16 observations, weights sum to 16" in page


def test_a_run_is_repeated_to_the_bit(tmp_path: Path):
    done = en4dvar.run(write(tmp_path), overrides={"output.directory": str(tmp_path / "out"), "output.report": False})
    assert {axis.name for axis in done.axes} == {"p", "q", "heads"}
    again = rerun(tmp_path / "out")
    assert again.same, again
    assert not again.sets[0].data
    (tmp_path / "f.csv").write_text("changed", encoding="utf-8")
    assert "has changed since" in rerun(tmp_path / "out").sets[0].data
    with pytest.raises(ConfigError, match=r"out: .* has several series; it cannot be estimated with others"):
        join([tmp_path / "out"], ["a"], tmp_path / "joint")
