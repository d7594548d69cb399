"""``en4dvar calibrate``: right configurations pass, wrong errors are seen, what is kept goes on to the same bits."""

from __future__ import annotations

import ast
import re
from dataclasses import replace

import numpy as np
import pytest
import yaml
from click.testing import CliRunner
from doc_pages import ROOT, blocks
from toy_config import write_toy

import en4dvar
from en4dvar.cli import main
from en4dvar.config import load_config
from en4dvar.plumbing.errors import ConfigError, DataError, En4dvarError, OutputError
from en4dvar.report.calibration import ERRORS, FIT, Judged, Verdict, load_calibration

QUIET = {"output.report": False, "assimilation.members": 24}


@pytest.fixture
def toy(tmp_path):
    prior = ("mean: maximum, std: 1 %", "mean: 100 um, std: 3 um")
    return write_toy(tmp_path, prior, ("toy_models:Oscillator", "execution_models:Swift"))


def sixty(toy, out, **options):
    return en4dvar.calibrate(toy, options.pop("sets", 60), out=out, **{"overrides": QUIET, **options})


def test_a_right_configuration_passes(toy, tmp_path):
    result = sixty(toy, tmp_path / "out")
    assert [verdict.quantity for verdict in result.verdicts] == ["A", "k", FIT, ERRORS]
    assert not any(verdict.off for verdict in result.verdicts)
    assert result.remarks == ["60 sets show no sign that the posterior is not calibrated"]
    (position,) = np.flatnonzero([name == "A" for name, _ in result.quantities])
    truths = (result.column("truth", position) - 100) / 3  # um, drawn from the prior
    assert abs(truths.mean()) < 4 / np.sqrt(60)
    assert 0.7 < truths.std() < 1.4
    assert result.summary().shape[0] == 4


@pytest.mark.slow
@pytest.mark.parametrize(("std", "size"), [("2.6 um", "larger"), ("1.4 um", "smaller")])
def test_errors_of_a_wrong_size_are_seen(toy, tmp_path, std, size):
    result = sixty(toy, tmp_path / "out", sets=100, made_with={"data.error.position_std": std})
    fit, errors = (next(v for v in result.verdicts if v.quantity == quantity) for quantity in (FIT, ERRORS))
    assert fit.off
    assert errors.off
    assert errors.p < 1e-3
    assert errors.words.startswith(f"the errors of the readings are {size} than data.error says")
    others = [verdict for verdict in result.verdicts if verdict.quantity not in (FIT, ERRORS)]
    wide = np.mean([verdict.std for verdict in others])
    assert wide > 1.1 if size == "larger" else wide < 0.9


ESTIMATED = {
    "sigma": {"parameters.sigma": {"prior": "lognormal", "median": 1, "log_std": 1}},
    "discrepancy": {
        "data.error.position_std": "0.5 um",
        "data.error.discrepancy": {
            "amplitude": {"median": "2 um", "log_std": 1},
            "length": {"median": "30 ms", "log_std": 0.5},
        },
    },
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["sigma", "discrepancy"])
def test_errors_of_a_size_that_parameters_tell_are_right(toy, tmp_path, kind):
    """Each member has a size of its own, by which J_o of readings drawn at it differs."""
    estimated = {**QUIET, **ESTIMATED[kind]}
    result = en4dvar.calibrate(toy, 40, overrides=estimated, out=tmp_path / "out")
    (errors,) = (verdict for verdict in result.verdicts if verdict.quantity == ERRORS)
    assert errors.p > 0.05


@pytest.mark.slow
def test_errors_larger_than_their_estimated_scale_says_are_seen(toy, tmp_path):
    """The scale explains them, so that the other parameters are right."""
    std = {"data.error.position_std": "3 um"}
    estimated = {**QUIET, "parameters.sigma": {"prior": "lognormal", "median": 1, "log_std": 0.2}}
    result = en4dvar.calibrate(toy, 60, overrides=estimated, made_with=std, out=tmp_path / "out")
    off = {verdict.quantity: verdict.words for verdict in result.verdicts if verdict.off}
    assert {"A", "k"}.isdisjoint(off)
    assert off["sigma"].startswith("sigma: values are too high")
    assert off[ERRORS].startswith("the errors of the readings are larger than data.error says")


@pytest.mark.slow
def test_a_value_that_is_wrong_is_seen(toy, tmp_path):
    """A damping that the readings have and the estimate has not moves k."""
    result = sixty(toy, tmp_path / "out", sets=40, made_with={"parameters.c": "0.03 N s/m"})
    assert any(verdict.off for verdict in result.verdicts)
    kept = tmp_path / "out" / "config.resolved.yaml"
    assert "# made_with:\n#   parameters.c: 0.03 N s/m\n" in kept.read_text()
    assert yaml.safe_load(load_config(kept).resolved) == yaml.safe_load(kept.read_text())


@pytest.mark.slow
def test_more_sets_leave_the_first_as_they_were_for_any_workers(toy, tmp_path):
    whole = sixty(toy, tmp_path / "whole", sets=9)
    sixty(toy, tmp_path / "parts", sets=4)
    with pytest.raises(OutputError, match="made_with"):
        sixty(toy, tmp_path / "parts", sets=9, resume=True, made_with={"parameters.c": "0.03 N s/m"})
    sixty(toy, tmp_path / "parts", sets=9, resume=True)
    threads = en4dvar.calibrate(
        toy, 9, overrides={**QUIET, "execution.executor": "processes", "execution.workers": 2}, out=tmp_path / "two"
    )
    text = (tmp_path / "whole" / "calibration.csv").read_bytes()
    assert (tmp_path / "parts" / "calibration.csv").read_bytes() == text
    assert (tmp_path / "two" / "calibration.csv").read_bytes() == text
    assert len(threads.sets) == len(whole.sets) == 9


DAMPED = {**QUIET, "parameters.c": {"prior": "lognormal", "median": "0.02 N s/m", "log_std": 0.3}}


def test_readings_of_a_law_that_lacks_a_parameter_leave_its_ranks_out(toy, tmp_path):
    own = {"A": {"prior": "normal", "mean": "100 um", "std": "3 um"}, "k": {"prior": "lognormal", "median": "3 N/m"}}
    own["k"]["log_std"] = 0.3
    made = {"model.name": "toy_models:Undamped", "parameters": own}
    result = en4dvar.calibrate(toy, 3, overrides=DAMPED, made_with=made, out=tmp_path / "out")
    assert len(result.good) == 3
    assert [verdict.quantity for verdict in result.verdicts] == ["A", "k"]
    assert "no ranks of c, fit, errors: what made the readings has no such value" in result.remarks


def test_lost_members_are_no_part_of_the_posterior_that_is_judged(toy, tmp_path):
    lost = {"model.name": "toy_models:Brittle", "data.error.position_std": "2 mm", "assimilation.refine": "none"}
    result = sixty(toy, tmp_path / "out", sets=3, overrides={**QUIET, **lost})
    names = [name for name, _ in result.quantities]
    assert any("members-lost" in judged.cautions for judged in result.good)
    assert result.column("q95", names.index("k")).max() <= 3.5
    assert np.isfinite(result.column("z", names.index(FIT))).all()
    assert {judged.members for judged in result.good} == {24}
    ranks = result.ranks(names.index(FIT))
    assert len(ranks) == len(result.good)
    assert set(ranks) <= set(range(25))


def test_a_truth_at_the_limit_of_a_prior_has_the_lowest_rank(toy, tmp_path):
    made = {"parameters.c": "0 N s/m"}
    result = en4dvar.calibrate(toy, 3, overrides=DAMPED, made_with=made, out=tmp_path / "out")
    names = [name for name, _ in result.quantities]
    assert result.column("rank", names.index("c")).tolist() == [0, 0, 0]
    assert result.column("truth", names.index("c")).tolist() == [0, 0, 0]
    assert np.isfinite(result.column("rank", names.index(FIT))).all()
    (damping,) = (verdict for verdict in result.verdicts if verdict.quantity == "c")
    assert (damping.half, damping.most) == (0, 0)


@pytest.mark.slow
def test_the_other_law_of_the_documentation_is_estimated(tmp_path, monkeypatch):
    monkeypatch.chdir(ROOT)
    (example,) = (block for block in blocks(ROOT / "docs" / "calibrate.md") if block.language == "python")
    made = ast.literal_eval(re.search(r"made_with=({.*?})", example.body)[1])
    result = en4dvar.calibrate("configs/quickstart.yaml", 2, overrides=QUIET, made_with=made, out=tmp_path / "out")
    assert [verdict.quantity for verdict in result.verdicts] == ["G", "alpha", "mu", "R0", "t_s", FIT, ERRORS]


@pytest.mark.parametrize(
    ("quantity", "mean", "std", "half", "most", "words"),
    [
        ("alpha", -3.0, 0.3, 0, 0, "alpha: values are too high and intervals hold the truth too rarely"),  # one truth
        ("alpha", 0.0, 1.4, 36, 76, "alpha: intervals hold the truth too rarely"),
        ("alpha", 0.0, 0.6, 75, 99, "alpha: intervals hold the truth too often"),
        ("alpha", 0.1, 1.0, 50, 90, "alpha: the shape of the posterior is off"),
        (
            FIT,
            1.0,
            1.2,
            40,
            85,
            "fit: members fit the readings better, beside the truth, than those of a right posterior do",
        ),
        (ERRORS, 1.0, 1.2, 40, 85, "the errors of the readings are larger than data.error says, or the model is wrong"),
        (ERRORS, -1.0, 1.2, 40, 85, "the errors of the readings are smaller than data.error says (ranks"),
    ],
)
def test_what_is_off_is_told_by_how_many_truths_are_held(quantity, mean, std, half, most, words):
    assert Verdict(quantity, "1", 100, 1e-4, mean, std, half, most, off=True).words.startswith(words)


def test_sets_without_a_posterior_are_told(toy, tmp_path):
    result = sixty(toy, tmp_path / "out", sets=3)
    failed = replace(result, sets=(*result.sets, Judged(4, "toy", failure="lost")))
    assert "1 of 4 sets have no posterior: lost" in failed.remarks
    assert len(failed.good) == 3


def test_sets_that_all_fail_end_with_the_first_reason(toy, tmp_path):
    fragile = {**QUIET, "model.name": "toy_models:Fragile"}
    with pytest.raises(En4dvarError, match="all 2 sets failed, the first: no truth drawn from the prior can be run"):
        en4dvar.calibrate(toy, 2, overrides=fragile, out=tmp_path / "out")


def test_what_cannot_be_done_is_told(toy, tmp_path):
    with pytest.raises(ConfigError, match="give at least 2"):
        sixty(toy, tmp_path / "out", sets=1)
    with pytest.raises(DataError, match="not at the times"):
        sixty(toy, tmp_path / "out", made_with={"data.window": {"end": "100 ms"}})
    with pytest.raises(ConfigError, match=r"--made-with data\.windo: unknown key"):
        sixty(toy, tmp_path / "out", made_with={"data.windo": 3})
    with pytest.raises(ConfigError, match=r"--made-with seed: has no part in making readings"):
        sixty(toy, tmp_path / "out", made_with={"seed": 3})
    with pytest.raises(ConfigError, match=r"^with what --made-with changes: --made-with modl\.name: modl: unknown key"):
        sixty(toy, tmp_path / "out", made_with={"modl.name": "toy"})
    (tmp_path / "out").mkdir(exist_ok=True)
    (tmp_path / "out" / "calibration.csv").write_text("set,data_set\n1,\n")
    with pytest.raises(OutputError, match="not a table of 'en4dvar calibrate'"):
        load_calibration(tmp_path / "out")


def test_the_command_prints_the_table_and_writes_the_page(toy, tmp_path):
    out = tmp_path / "out"
    words = ["calibrate", str(toy), "--sets", "12", "--out", str(out), "--set", "assimilation.members=24"]
    done = CliRunner().invoke(main, words)
    assert done.exit_code == 0, done.output
    assert "p of uniform ranks" in done.stdout
    assert "12 sets show no sign" in done.stderr
    page = (out / "calibration.html").read_text()
    assert "Calibration of" in page
    assert '"errors" is the same half sum' in page
    assert page.count("<svg") >= 1
    assert load_config(out / "config.resolved.yaml").name == "toy"
    (out / "calibration.html").unlink()
    assert CliRunner().invoke(main, ["report", str(out)]).exit_code == 0
    assert (out / "calibration.html").exists()
