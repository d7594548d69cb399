"""What else must be known for what is wanted, and what equal experiments share, against linear closed forms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_information import MEAN, STD, _problem

from en4dvar.estimation.design.evaluate import SampleSizes, evaluate
from en4dvar.plumbing.errors import ConfigError
from en4dvar.report.design import design_table
from en4dvar.results.design_file import load_designs
from en4dvar.runs.design_run import run_design

SIZES = SampleSizes(draws=20)


def _posterior(problem, prior, alike=1, common=()):
    """Std of the first parameter, by the whole problem of all experiments with what each has of its own."""
    times, j = problem.observations.times, np.arange(3)
    H, std = np.cos(times[:, None] * j + j**2 / 3), problem.observations.std[0]
    own = [b for b in range(1, 3) if "abc"[b] not in common]
    shared = [b for b in range(3) if b not in own]
    columns = len(shared) + alike * len(own)
    rows = np.zeros((alike * len(times), columns))
    for k in range(alike):
        part = slice(k * len(times), (k + 1) * len(times))
        rows[part, : len(shared)] = H[:, shared]
        first = len(shared) + k * len(own)
        rows[part, first : first + len(own)] = H[:, own]
    stds = np.array([*(prior[b] for b in shared), *([prior[b] for b in own] * alike)])
    return np.sqrt(np.linalg.inv(np.diag(stds**-2.0) + rows.T @ rows / std**2)[0, 0])


@pytest.mark.parametrize("common", [(), ("b",), ("b", "c")])
@pytest.mark.parametrize("alike", [1, 5])
def test_experiments_alike_share_what_is_common(common, alike):
    problem = _problem()
    (found,) = evaluate(problem, ["a"], SIZES, "laplace", 1, (alike,), common=common)
    assert found.std[0] == pytest.approx(_posterior(problem, STD, alike, common), rel=1e-6)


@pytest.mark.parametrize("alike", [1, 5])
def test_what_the_others_must_be_known_to(alike):
    """With the factor that is found, the posterior of the whole problem is what is wanted."""
    problem = _problem(1.0)
    wanted = 0.5 * sum(_posterior(problem, np.array(STD) * (1, f, f), alike, ("b",)) for f in (1e-6, 1))
    (found,) = evaluate(problem, ["a"], SIZES, "laplace", 1, (alike,), common=["b"], wanted={"a": (wanted, False)})
    b, c, both = found.needed[0]
    np.testing.assert_allclose(found.others[0], STD[1:])

    def after(*factors):
        return _posterior(problem, np.array(STD) * (1, *factors), alike, ("b",))

    assert after(both, both) == pytest.approx(wanted, rel=1e-4)
    for factor, alone in ((b, after(b, 1)), (c, after(1, c))):
        assert factor == 0 or alone == pytest.approx(wanted, rel=1e-4)
    assert (b == 0) == (after(1e-6, 1) > wanted)
    assert (c == 0) == (after(1, 1e-6) > wanted)


def test_a_calibration_beside_correlated_priors():
    """Known f times as well by a measurement of its own: the posterior with that one."""
    problem = _problem(1.0, correlated=True)
    times, j = problem.observations.times, np.arange(3)
    H = np.cos(times[:, None] * j + j**2 / 3) / problem.observations.std[0]
    half = problem.prior.from_white_change(np.eye(3))
    precision = np.linalg.inv(half.T @ half) + H.T @ H

    def after(of_b):
        return np.sqrt(np.linalg.inv(precision + np.diag([0, of_b, 0]))[0, 0])

    wanted = 0.5 * (after(0.0) + after(1e9))
    (found,) = evaluate(problem, ["a"], SIZES, "laplace", 1, wanted={"a": (wanted, False)})
    factor = found.needed[0, 0]
    assert 0 < factor < 1
    assert after((factor**-2 - 1) / STD[1] ** 2) == pytest.approx(wanted, rel=1e-4)


@pytest.mark.parametrize(("wanted", "factor"), [(1e-6, 0.0), (MEAN[0] + 10, np.inf)])
def test_never_and_always(wanted, factor):
    (found,) = evaluate(_problem(), ["a"], SIZES, "laplace", 1, wanted={"a": (wanted, False)})
    assert set(found.needed[0, :2]) == {factor}


def _plan(error, wanted):
    """x = scale · level, one reading of it after another: no readings tell it better than the scale is known."""
    return {
        "name": "scaled",
        "model": {"name": "trend"},
        "data": {
            "path": "not yet measured.csv",
            "columns": {"time": {"name": "t", "unit": "1"}, "x": {"name": "x", "unit": "1"}},
            "error": {"x_std": error},
        },
        "parameters": {
            "level": {"prior": "lognormal", "median": 2, "log_std": 0.5},
            "slope": 0,
            "reading_scale": {"prior": "lognormal", "median": 1, "log_std": 0.03},
        },
        "design": {
            "about": ["level"], "common": ["reading_scale"], "wanted": {"level": wanted}, "experiments": [100],
            "times": {"from": 0, "to": 9, "step": 1}, "draws": 20, "method": "laplace",
        },
        "output": {"report": False},
    }  # fmt: skip


@pytest.mark.parametrize(
    ("error", "wanted", "words"),
    [
        (1e-3, "1 %", "level to ± 1 % if one of these were known better: reading_scale to 1 %"),
        (1e-3, "5 %", "level to ± 5 % as long as each is known: reading_scale to 5 %"),
        (1e3, "1 %", "level to ± 1 %: not with these readings, even if all else were known"),
    ],
)
def test_it_is_said(tmp_path, error, wanted, words):
    """The level is as badly known as the scale; 1e-3 and the prior of the level change the third digit."""
    found, directory = run_design(_plan(error, wanted), out=tmp_path / "out", overrides={"output.report": True})
    assert words in design_table(found)
    written = words.replace("reading_scale", "<i>b</i>").replace("level", "<i>x</i><sub>0</sub>")
    assert written in (directory / "design.html").read_text(encoding="utf-8")
    held = load_designs(directory / "design.nc").asked
    earlier = replace(held, other_symbols=()).written  # as of a file of an earlier version
    assert [name for name, *_ in earlier.others] == ["reading_scale"]
    assert "level_needs_reading_scale_factor" in (directory / "designs.csv").read_text()


@pytest.mark.parametrize("wanted", [{"reading_scale": "1 %"}, {"level": "soon"}])
def test_what_cannot_be_wanted(tmp_path, wanted):
    plan = _plan(1.0, "1 %")
    plan["design"]["wanted"] = wanted
    with pytest.raises(ConfigError, match=r"design\.wanted"):
        run_design(plan, out=tmp_path / "out")
