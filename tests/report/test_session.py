"""What results show in a session: short, with units; as tables in display units; as figures."""

from __future__ import annotations

import sys
import types
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import xarray as xr
from toy_config import csv_text, write_toy

import en4dvar
from en4dvar.plumbing.errors import ConfigError
from en4dvar.report.result import Result, load_result

TWIN = {
    "name": "twin", "model": {"name": "lorenz63"}, "assimilation": {"scheme": "etkf", "members": 5},
    "twin": {"cycles": 4, "interval": 0.1, "error": {"x_std": 1.0}, "initial_std": {"x": 1.0, "y": 1.0, "z": 1.0}},
}  # fmt: skip


@pytest.fixture
def result(analysis: en4dvar.Analysis) -> Result:
    return Result.from_analysis(analysis, {})


def test_a_posterior_is_shown_in_one_line_with_units(result: Result, analysis: en4dvar.Analysis) -> None:
    G = next(row for row in result.rows if row.name == "G")
    for shown in (repr(result), repr(analysis)):
        assert len(shown) < 300
        assert "\n" not in shown
        assert "kPa" in shown
    assert repr(result).startswith(f"<Result {result.name}: G {G.mean:.2g}"[:20])


def test_a_group_that_is_not_there_is_told(result: Result) -> None:
    with pytest.raises(en4dvar.ConfigError, match="no group 'posteriors'; did you mean 'posterior'"):
        result.dataset("posteriors")


def test_the_summary_is_a_table_in_display_units(result: Result) -> None:
    table = result.summary()
    with pd.option_context("display.max_columns", 3):  # as in a narrow terminal
        assert set(table.columns) <= set(str(table).split())
    assert list(table.index) == [row.name for row in result.rows]
    for row in result.rows:
        assert table.loc[row.name, "unit"] == row.unit
        expected = np.nan if row.untrusted else row.q95
        assert table.loc[row.name, "q95"] == pytest.approx(expected, nan_ok=True)
        assert table.loc[row.name, "mean"] == row.mean


@pytest.mark.filterwarnings("ignore")  # of ArviZ, about what it will be
@pytest.mark.slow
def test_arviz_shows_display_units_and_compares_chains(result: Result) -> None:
    import arviz as az

    data = result.to_inference_data(units="display", chains=4)
    living = int(result.alive.sum())
    posterior = data["posterior"]
    assert posterior["G"].shape == (4, living // 4)
    assert data["log_likelihood"]["R"].shape[:2] == (4, living // 4)
    table = az.summary(data, round_to="none")
    for row in result.rows:
        left = result.members("posterior", row.name)[: 4 * (living // 4)]
        assert table.loc[row.name, "mean"] == pytest.approx(left.mean(), rel=1e-12)
        assert posterior[row.name].attrs["units"] == row.unit
    assert az.plot_rank(data, var_names=["G"]) is not None
    assert float(result.to_inference_data()["posterior"]["G"].max()) == float(result.posterior["G"].max())  # SI
    with pytest.raises(ConfigError, match="too few for 40 chains"):
        result.to_inference_data(chains=40)


def test_without_arviz_it_is_told_how_to_install_it(result: Result, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "arviz", None)
    with pytest.raises(ConfigError, match="needs ArviZ: pip install arviz"):
        result.to_inference_data()


def test_from_version_1_on_arviz_takes_a_tree(result: Result, monkeypatch: pytest.MonkeyPatch) -> None:
    """ArviZ 1.x has no InferenceData; its functions take xarray's DataTree, by the same names of groups."""
    before = result.to_inference_data(units="display", chains=4)
    monkeypatch.setitem(sys.modules, "arviz", types.ModuleType("arviz"))
    tree = result.to_inference_data(units="display", chains=4)
    assert isinstance(tree, xr.DataTree)
    assert {"posterior", "prior", "log_likelihood", "observed_data"} <= set(tree.children)
    for name in () if isinstance(before, xr.DataTree) else before.groups():  # of an ArviZ before that
        xr.testing.assert_identical(tree[name].to_dataset(), before[name])


def test_arviz_gets_members_that_are_alive(result: Result, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "arviz", types.ModuleType("arviz"))
    shown = result.to_inference_data()["posterior"]["G"]
    assert 1 < result.alive.sum() < len(result.alive)
    assert shown.dims == ("chain", "draw")
    np.testing.assert_array_equal(shown.values[0], result.posterior["G"].values[0, result.alive])


def test_a_twin_experiment_and_a_sweep(tmp_path: Path) -> None:
    own = {**TWIN, "output": {"directory": str(tmp_path / "twin"), "report": False}}
    twin = en4dvar.run_twin(own)
    score = twin.scores["analysis"]
    assert len(repr(twin)) < 200
    assert f"analysis RMSE {score.mean_rmse:.3g}" in repr(twin)
    assert str(twin).splitlines()[0].split() == ["estimate", "RMSE", "spread"]
    assert twin.summary().loc["analysis", "rmse"] == score.mean_rmse
    axes = twin.plot().axes
    assert len(axes) == len(twin.scores)
    sweep = en4dvar.sweep_twin(own, {"assimilation.inflation": [1.0, 1.1]}, seeds=2, out=tmp_path / "sweep", workers=1)
    assert len(repr(sweep)) < 200
    assert list(sweep.summary()["assimilation.inflation"].unique()) == [1.0, 1.1]
    assert sweep.plot().axes[0].get_ylabel() == "RMSE"


def test_a_campaign(tmp_path: Path) -> None:
    path = write_toy(tmp_path)
    (tmp_path / "other.csv").write_text(csv_text())
    own = {"data.path": str(tmp_path / "*.csv"), "output.report": False, "output.directory": str(tmp_path / "run")}
    config = en4dvar.load_config(path, own)
    campaign = en4dvar.run_campaign(config)
    assert repr(campaign) == f"<Campaign of 2 data sets in {campaign.directory}>"
    assert str(campaign).splitlines()[0].startswith("data set")
    table = campaign.summary()
    for one in campaign:
        assert [table.loc[(one.name, row.name), "q50"] for row in one.rows] == [row.q50 for row in one.rows]
        assert load_result(campaign.outcomes[0].file).plot().axes
    assert campaign.plot().axes


def test_a_sequence_and_a_simulation(tmp_path: Path) -> None:
    times = np.arange(1.0, 5.0)
    followed = en4dvar.estimate_sequence(
        {"name": "lorenz63"}, {"time": 0.1 * times, "x": np.sin(times)}, error=1.0,
        initial_std={"x": 1.0, "y": 1.0, "z": 1.0}, assimilation={"scheme": "etkf", "members": 6},
    )  # fmt: skip
    assert len(repr(followed)) < 300
    assert "at the end" in str(followed)
    assert list(followed.summary().columns) == ["mean", "std", "unit"]
    assert followed.plot().axes
    simulated = en4dvar.simulate(en4dvar.load_config(write_toy(tmp_path)), times)
    assert len(repr(simulated)) < 200
