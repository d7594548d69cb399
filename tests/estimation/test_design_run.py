"""``en4dvar design`` from a file: bits, files, resume, words."""

from __future__ import annotations

import csv
import json
import re
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner
from run_files import TESTS
from toys import Vectorised

import en4dvar
from en4dvar.cli import main
from en4dvar.estimation.design import nested
from en4dvar.model.forward import ValidityLimit
from en4dvar.plumbing.errors import ConfigError, DataError, En4dvarError, OutputError
from en4dvar.report.design import design_table, fans, front, gains, needs, readings_text, remarks, with_pretty_unit
from en4dvar.results.design_file import load_designs
from en4dvar.runs import design_run
from en4dvar.runs.design_run import run_design

PAGE = {"output.report": True}


def _plan(**design):
    """Without the page: drawing it takes longer than what it shows; those who look at it ask with ``PAGE``."""
    return {
        "name": "plan",
        "seed": 3,
        "model": {"name": "toys:Vectorised"},
        "data": {
            "path": "not yet measured.csv",
            "columns": {"time": {"name": "t", "unit": "s"}, "y": {"name": "y", "unit": "m"}},
            "error": {"y_std": "0.3 m"},
        },
        "parameters": {
            "a": {"prior": "lognormal", "median": "1 m", "log_std": 0.5},
            "b": {"prior": "normal", "mean": "0.2 m", "std": "1 m"},
        },
        "design": {
            "times": {"from": "0.1 s", "to": "2.5 s", "step": "0.4 s"},
            "knobs": {
                "error": {"key": "data.error.y_std", "values": ["0.1 m", "1 m"]},
                "every": {"key": "design.times.step", "values": ["0.2 s", "0.4 s", "0.8 s"]},
            },
            "draws": 20,
            "simulated": 20,
            "inner": 50,
            **design,
        },
        "output": {"report": False},
    }


def _same(one, other):
    assert [row.settings for row in one.rows] == [row.settings for row in other.rows]
    for a, b in zip(one.rows, other.rows, strict=True):
        assert (a.result.gain, a.result.error, a.result.method) == (b.result.gain, b.result.error, b.result.method)
        np.testing.assert_array_equal(a.result.std, b.result.std)
        np.testing.assert_array_equal(a.result.fan, b.result.fan)


@pytest.mark.slow
def test_every_combination_and_the_file_itself(tmp_path):
    found, directory = run_design(_plan(), out=tmp_path / "out", overrides=PAGE)
    assert [row.settings for row in found.rows][:3] == [
        {},
        {"error": "0.1 m", "every": "0.2 s"},
        {"error": "0.1 m", "every": "0.4 s"},
    ]
    gains = {tuple(row.settings.values()): row.result.gain for row in found.rows}
    assert gains["0.1 m", "0.2 s"] > gains["0.1 m", "0.4 s"] > gains["1 m", "0.4 s"] > gains["1 m", "0.8 s"]
    assert gains["0.1 m", "0.2 s"] - gains["1 m", "0.2 s"] == pytest.approx(2 * np.log(10), abs=0.6)  # two parameters
    rows = list(csv.DictReader((directory / "designs.csv").read_text().splitlines()))
    assert len(rows) == 7
    assert float(rows[0]["gain_nats"]) == max(gains.values())
    assert [len(row.result.times) for row in front(found)] == [4, 7, 13]
    page = (directory / "design.html").read_text()
    assert page.count("<svg") == 3
    assert "a to ±" in page


@pytest.mark.parametrize("executor", ["threads", "processes"])
@pytest.mark.slow
def test_the_same_bits_on_any_workers(tmp_path, executor):
    one, _ = run_design(_plan(method="nested"), out=tmp_path / "one", overrides={"execution.executor": "serial"})
    settings = {"execution.executor": executor, "execution.workers": 2}
    other, _ = run_design(_plan(method="nested"), out=tmp_path / "other", overrides=settings)
    _same(one, other)


@pytest.mark.slow
def test_resumed(tmp_path, monkeypatch):
    """Stopped after three designs, it goes on with the fourth, to the same bits."""
    whole, _ = run_design(_plan(), out=tmp_path / "whole")
    settings = {"execution.executor": "serial", "execution.checkpoint_every": 0}

    def stop(count, total):
        if count == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_design(_plan(), out=tmp_path / "out", overrides=settings, on_design=stop)
    calls, evaluate = [], design_run.evaluate
    monkeypatch.setattr(design_run, "evaluate", lambda *args: calls.append(1) or evaluate(*args))
    again, _ = run_design(_plan(), out=tmp_path / "out", overrides=settings, resume=True)
    _same(whole, again)
    assert len(calls) == 7 - 3 + 4  # the checks of auto follow
    with pytest.raises(OutputError, match="force"):
        run_design(_plan(), out=tmp_path / "out")


@pytest.mark.parametrize("log_std", [1e-3, 1.5])
def test_a_discrepancy_of_the_model(log_std, tmp_path):
    """Amplitude and length have their prior, here all but known or wide: against ½ ln det of R + A in closed form."""
    plan = _plan(knobs={}, about=["a", "b"], method="laplace")
    plan["parameters"] = {name: {"prior": "normal", "mean": "0.2 m", "std": "1 m"} for name in ("a", "b")}
    plan["parameters"]["sigma"] = {"prior": "lognormal", "median": 1, "log_std": log_std}
    of = {"amplitude": {"median": "0.4 m", "log_std": log_std}, "length": {"median": "0.5 s", "log_std": log_std}}
    plan["data"]["error"]["discrepancy"] = {**of, "kernel": "exponential"}
    found, _ = run_design(plan, out=tmp_path / "out")
    t, j = np.arange(0.1, 2.51, 0.4), np.arange(2)
    H = np.cos(t[:, None] * j + j**2 / 3)
    K = 0.09 * np.eye(len(t)) + 0.16 * np.exp(-np.abs(t[:, None] - t) / 0.5)
    exact = 0.5 * np.linalg.slogdet(np.eye(2) + H.T @ np.linalg.solve(K, H))[1]
    assert found.rows[0].result.gain == pytest.approx(exact, abs=1e-3 if log_std < 1 else 0.6)


@pytest.mark.slow
def test_chosen_readings_tell_more_than_as_many_at_a_fixed_rate(tmp_path):
    chosen = {"times": {"from": "0.1 s", "to": "2.5 s", "step": "0.1 s"}, "knobs": {}, "choose": {"readings": 6}}
    found, _ = run_design(_plan(**chosen), out=tmp_path / "chosen")
    fixed, _ = run_design(_plan(knobs={}, times={"from": "0.1 s", "to": "2.5 s", "step": "0.48 s"}), out=tmp_path / "f")
    assert len(found.rows[0].result.times) == len(fixed.rows[0].result.times) == 6
    assert found.rows[0].result.gain > fixed.rows[0].result.gain + 0.2


def test_experiments_alike(tmp_path):
    found, _ = run_design(_plan(knobs={}, about=["a"], experiments=[1, 4], method="laplace"), out=tmp_path / "out")
    one, four = (row.result for row in found.rows)
    assert (one.alike, four.alike) == (1, 4)
    assert four.gain > one.gain
    assert [row.price for row in found.rows] == [7, 28]
    (panel,) = (panel for row in fans(found).rows for panel in row.panels)
    worth = f"{one.worth:.2f} nats of 1 experiment, {four.worth:.2f} nats of 4 experiments"
    assert panel.title.replace("\n", " ") == f"as in the file: {worth}"


@pytest.mark.parametrize("thin", [0.0, 0.9])
def test_a_nested_estimate_of_few_effective_draws_is_no_check(tmp_path, monkeypatch, thin):
    """Five nats more than the linearised estimate, which it replaces only where enough draws are behind it."""

    def rough(problem, about, sizes, method, *args):
        return [
            replace(it, method=method, gain=it.gain + 5, thin=thin) if method == "nested" and it.alike == 1 else it
            for it in evaluate(problem, about, sizes, "laplace", *args)
        ]

    evaluate = design_run.evaluate
    monkeypatch.setattr(design_run, "evaluate", rough)
    plan = _plan(knobs={}, about=["a"], experiments=[1, 4])
    found, _ = run_design(plan, out=tmp_path / "out", overrides={"execution.executor": "serial"})
    told, one = "\n".join(remarks(found)), found.rows[0].result
    assert (one.method, one.thin) == ("laplace" if thin else "nested", thin)
    assert ("the linearised information, which stands" in told) == bool(thin)
    assert ("1 of these experiments (by nested) cannot tell more than 4 (by laplace)" in told) == (not thin)


@pytest.mark.parametrize("enough", [1e9, 1.0])
def test_a_check_that_is_of_no_use_is_given_up(tmp_path, monkeypatch, enough):
    """Where too few draws are effective behind 3 of 20 simulated readings, the other 17 would cost more for nothing."""
    monkeypatch.setattr(nested, "ENOUGH", enough)
    monkeypatch.setattr(nested, "ROUNDS", 2)
    explained, calls, told = nested.explained, [], []
    monkeypatch.setattr(nested, "explained", lambda *args: calls.append(1) or explained(*args))
    settings = {"execution.executor": "serial"}
    found, folder = run_design(
        _plan(knobs={}, about=["a"]), out=tmp_path / "out", overrides=settings, on_cost=told.append
    )
    assert len(calls) == 2 * (3 if enough > 1 else 20)
    assert found.rows[0].result.thin == (1.0 if enough > 1 else 0.0)
    assert told[0].startswith("cost: 1 design by laplace, about 60 forward runs each; then 1 design by nested, about ")
    assert "as a check, and of all if that finds them off; '--set design.method=laplace' leaves this out" in told[0]
    log = (folder / "run.log").read_text()
    assert told[0] in log
    assert ("100 % of the simulated readings are explained by too few effective draws" in log) == (enough > 1)


@pytest.mark.parametrize(
    ("method", "laws"),
    [
        ("linear", {}),
        ("laplace", {}),
        ("nested", {}),
        pytest.param("nested", {"one": {}, "other": {"parameters.b.std": "2 m"}}, marks=pytest.mark.slow),
    ],
)
def test_the_runs_are_as_many_as_was_said(tmp_path, method, laws):
    plan = _plan(knobs={}, about=["a"], laws=laws, method=method)
    found, folder = run_design(plan, out=tmp_path / "out", overrides={"execution.executor": "serial"})
    (said,) = (line for line in (folder / "run.log").read_text().splitlines() if "cost: 1 design by" in line)
    least, _, most = re.search(r"about ([\d ]+)( to ([\d ]+))? forward runs each", said).groups()
    least, most = (float(text.replace(" ", "")) for text in (least, most or least))
    assert 0.95 * least <= found.rows[0].result.forward_runs <= 1.05 * most


def test_no_number_is_said_that_is_far_above_what_a_plan_takes(tmp_path, monkeypatch):
    """``configs/lotka_volterra_design.yaml`` takes 208 500 runs for a nested estimate of the file's own design."""

    def stop(*_):
        raise En4dvarError("all is said")

    monkeypatch.setattr(design_run.DesignKind, "_evaluate", stop)
    told = []
    with pytest.raises(En4dvarError, match="all is said"):
        run_design(TESTS.parent / "configs" / "lotka_volterra_design.yaml", out=tmp_path / "out", on_cost=told.append)
    (cost,) = told
    least, most = map(float, re.findall(r"nested, about (\d+) to (\d+) forward runs each", cost)[0])
    assert least < 208_500 < most < 2 * 208_500


def test_linearised_information_that_is_off_is_told_before_all_is_evaluated_anew(tmp_path, monkeypatch):
    """Five nats, of each of seven designs."""

    def off(problem, about, sizes, method, *args):
        every = evaluate(problem, about, sizes, "linear", *args)
        return [replace(it, method=method, gain=it.gain + 5 * (method == "nested")) for it in every]

    evaluate, told = design_run.evaluate, []
    monkeypatch.setattr(design_run, "evaluate", off)
    settings = {"execution.executor": "serial"}
    found, _ = run_design(_plan(), out=tmp_path / "out", overrides=settings, on_cost=told.append)
    assert {row.result.method for row in found.rows} == {"nested"}
    assert re.search(
        "^the linearised information is off, of design 0 by -5 nats, .*; cost: . designs by nested", told[1]
    )


def test_a_design_that_cannot_be_made(tmp_path):
    """It is named, and the others are compared."""
    knobs = {"start": {"key": "design.times.to", "values": ["2.5 s", "1e9 s"]}}
    with pytest.raises(ConfigError, match="steps; give between 2 and a million"):
        run_design(_plan(knobs=knobs), out=tmp_path / "out")
    choose = {"n": {"key": "design.choose.readings", "values": [3, 50]}}
    found, _ = run_design(_plan(knobs=choose, choose={"readings": 3}), out=tmp_path / "out")
    assert [bool(row.failure) for row in found.rows] == [False, False, True]
    assert "no 50 of 7 readings" in found.rows[2].failure


class Bounded(Vectorised):
    """Valid where |y| is below 2 m."""

    validity = (ValidityLimit("y", 2.0),)


def test_what_a_design_must_keep_to(tmp_path):
    """More readings than the camera holds, a price too high: left out before the best is looked for, and named."""
    within = {"readings": 7, "price": 12}
    found, directory = run_design(_plan(within=within, experiments=[1, 2], method="laplace"), out=tmp_path / "out")
    assert {(len(row.result.times), row.result.alike) for row in found.rows if row.result} == {(7, 1), (4, 1), (4, 2)}
    told = "\n".join(remarks(found))
    assert "error 0.1 m, every 0.2 s; error 1 m, every 0.2 s: 13 readings: more than design.within.readings = 7" in told
    assert "a price of 13: more than design.within.price = 12" in told
    assert "as in the file; error 0.1 m, every 0.4 s; error 1 m, every 0.4 s: 2 experiments: a price of 14: " in told
    assert "2 experiments: a price of 14" in (directory / "run.log").read_text()


@pytest.mark.parametrize(("most", "kept"), [(0.9, True), (0.05, False)])
def test_designs_that_leave_what_the_model_is_valid_for(tmp_path, most, kept):
    plan = {**_plan(knobs={}, within={"beyond": most}, method="laplace"), "model": {"name": f"{__name__}:Bounded"}}
    if kept:
        assert 0.1 < run_design(plan, out=tmp_path / "out")[0].rows[0].result.beyond < 0.9
    else:
        with pytest.raises(ConfigError, match=r"leaves what the model is valid for: more than design\.within\.beyond"):
            run_design(plan, out=tmp_path / "out")


def test_when_to_stop(tmp_path):
    """Readings that tell nothing to speak of: it is said."""
    found, directory = run_design(
        _plan(knobs={}), out=tmp_path / "out", overrides={"data.error.y_std": "40 m", "design.method": "linear", **PAGE}
    )
    assert "less than design.enough = 0.1: no experiment among these is worth making" in remarks(found)[0]
    assert "is worth making" in (directory / "design.html").read_text()


def test_what_is_taken_to_the_lab(tmp_path):
    """When to read: a rate, or each chosen instant."""
    found, _ = run_design(_plan(knobs={}, method="laplace"), out=tmp_path / "out")
    assert readings_text(found, found.rows[0]) == "7 from 0.1 to 2.5 s, every 0.4 s"
    assert not remarks(found)
    three = _plan(knobs={}, choose={"readings": 3}, method="laplace")
    found, directory = run_design(three, out=tmp_path / "three", overrides=PAGE)
    taken = ", ".join(f"{t:.4g}" for t in found.rows[0].result.times)
    assert readings_text(found, found.rows[0]) == f"3, at {taken} s"
    assert f"3, at {taken} s" in (directory / "design.html").read_text()


def test_a_knob_that_is_called_as_a_column_of_the_table_has_one_of_its_own(tmp_path):
    knobs = {"price": {"key": "design.price.reading", "values": [2]}}
    _, directory = run_design(_plan(knobs=knobs, method="linear"), out=tmp_path / "out", overrides=PAGE)
    rows = list(csv.DictReader((directory / "designs.csv").read_text().splitlines()))
    assert {(row["price_2"], row["price"]) for row in rows} == {("", "7.0"), ("2", "14.0")}


def test_units_of_knobs_on_the_page_are_as_of_all_figures(tmp_path):
    """An axis said "every [us]"."""
    every = {"key": "design.times.step", "values": ["400000 us", "800000 us"]}
    plan, command = _plan(knobs={"every": every}, method="laplace"), f"en4dvar design {tmp_path}/plan.yaml"
    found, directory = run_design(plan, out=tmp_path / "out", overrides=PAGE, command=command)
    (panel,) = gains(found).rows[0].panels[:1]
    assert panel.xlabel == "every (µs)"
    page = (directory / "design.html").read_text(encoding="utf-8")
    assert "every 400000 µs" in page
    assert "every 400000 µs" in design_table(found)
    assert " us<" not in page
    assert "en4dvar design plan.yaml" in page  # no folder of the machine
    assert with_pretty_unit("neo-hookean") == "neo-hookean"
    assert with_pretty_unit("0.3") == "0.3"


def test_as_a_command(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "plan.yaml").write_text(json.dumps(_plan(knobs={}, method="laplace")))
    outcome = CliRunner().invoke(main, ["design", "plan.yaml", "--set", "output.report=true"])
    assert outcome.exit_code == 0, outcome.output
    assert "what is known" in outcome.output
    assert (tmp_path / "runs/plan_design/design.html").exists()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"about": ["c"]}, "c: not estimated; estimated are a, b"),
        ({"times": "often"}, "design.times: expected 'key: value' lines"),
        ({"knobs": {"x": {"key": "no such", "values": [1]}}}, "design.knobs.x.key"),
        ({"knobs": {"x": {"key": "parameters.zz", "values": [1]}}}, "zz"),
        ({"draws": 3}, "design.draws"),
        ({"method": "guess"}, "design.method"),
        ({"experiments": []}, "design.experiments"),
        (
            {"knobs": {"n": {"key": "design.experiments", "values": [1, 4]}}},
            r"^design\.knobs\.n: design\.experiments: expected a list, e\.g\. \[1, 2\], not 1$",
        ),
        ({"laws": {"a": {}, "b": {"model.law": "x"}}, "knobs": {}}, r"^design\.laws\.b: model\.law: unknown key"),
        ({"knobs": {k: {"key": "seed", "values": list(range(100))} for k in "ab"}}, "10000 combinations; at most 2000"),
    ],
)
def test_bad_input(tmp_path, change, message):
    with pytest.raises(En4dvarError, match=message):
        run_design(_plan(**change), out=tmp_path / "out")


def test_the_shipped_linear_plan_is_the_closed_form(tmp_path):
    found, _ = run_design(
        TESTS.parent / "configs" / "linear_design.yaml",
        overrides={"design.method": "laplace", "output.report": False},
        out=tmp_path / "line",
    )
    for row in found.rows:
        H = np.column_stack([np.ones_like(row.result.times), row.result.times])
        posterior = np.linalg.inv(np.diag([0.25, 1.0]) + H.T @ H / 0.25)
        assert row.result.gain == pytest.approx(-0.5 * np.log(posterior[1, 1]), abs=1e-8)
        assert row.result.std[0] == pytest.approx(np.sqrt(posterior[1, 1]), rel=1e-8)
    assert len(found.rows) == 7


@pytest.mark.slow
def test_two_rates_one_after_the_other(tmp_path):
    times = {"from": "0.5 s", "to": "1 s", "step": "0.1 s", "then": {"to": "2 s", "step": "0.5 s"}}
    knobs = {"late": {"key": "design.times.then.step", "values": ["0.25 s"]}}
    found, _ = run_design(_plan(knobs=knobs, times=times), out=tmp_path / "two")
    own, finer = (row.result.times for row in found.rows)
    np.testing.assert_allclose(own, [0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.5, 2.0])
    np.testing.assert_allclose(finer, [0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.25, 1.5, 1.75, 2.0])
    with pytest.raises(ConfigError, match=r"design\.times"):
        run_design(_plan(knobs={}, times={**times, "then": {"to": "0.7 s", "step": "0.5 s"}}), out=tmp_path / "no")


def test_times_or_a_file_of_them(tmp_path):
    plan = _plan(knobs={})
    del plan["design"]["times"]
    with pytest.raises(DataError, match=r"not yet measured\.csv: no such file"):
        run_design(plan, out=tmp_path / "out")
    assert not (tmp_path / "out").exists()
    plan["data"]["path"], plan["design"]["method"] = str(tmp_path / "measured.csv"), "linear"
    (tmp_path / "measured.csv").write_text("t,y\n0.1,1\n0.5,1\n0.9,1\n")
    three, _ = run_design(plan, out=tmp_path / "out")
    assert len(three.rows[0].result.times) == 3
    (tmp_path / "measured.csv").write_text("t,y\n0.1,1\n0.5,1\n0.9,1\n1.3,1\n")
    with pytest.raises(OutputError, match="cannot be resumed to the same result"):
        run_design(plan, out=tmp_path / "out", resume=True)


def test_after_a_run_there_is_less_to_learn(tmp_path):
    """The gain of two experiments is that of the first, and that of the second after it (a linear model)."""
    plan = _plan(knobs={}, about=["b"], method="linear")
    plan["parameters"]["a"] = {"prior": "normal", "mean": "1 m", "std": "0.001 m"}  # known, so that b is all there is
    times = np.arange(0.1, 2.6, 0.4)
    rows = [f"{t:.3f},{1 + 0.2 * np.cos(t + 1 / 3):.6f}" for t in times]
    (tmp_path / "measured.csv").write_text("\n".join(["t,y", *rows]))
    measured = {**plan, "data": {**plan["data"], "path": str(tmp_path / "measured.csv")}}
    en4dvar.run({**measured, "output": {"directory": str(tmp_path / "run"), "report": False}})
    before, _ = run_design(plan, out=tmp_path / "before")
    next_one, _ = run_design(plan, out=tmp_path / "next", after=tmp_path / "run")
    plan["design"] |= {"method": "laplace", "experiments": [2]}
    twice, _ = run_design(plan, out=tmp_path / "twice")
    one, other, both = (found.rows[0].result.gain for found in (before, next_one, twice))
    assert other < 0.5 < 1.5 < one
    assert one + other == pytest.approx(both, abs=0.02)
    with pytest.raises(En4dvarError, match=r"^--after: .*nowhere: no such file"):
        run_design(plan, out=tmp_path / "bad", after=tmp_path / "nowhere")


def test_after_a_run_its_members_hold_the_correlation_of_its_prior(tmp_path):
    plan, correlated = _plan(knobs={}, method="linear"), {"between": ["a", "b"], "correlation": -0.7}
    (tmp_path / "measured.csv").write_text("t,y\n0.1,1.2\n0.7,0.9\n1.3,0.5\n")
    measured = {**plan, "prior_correlation": [correlated]}
    measured["data"] = {**plan["data"], "path": str(tmp_path / "measured.csv")}
    en4dvar.run({**measured, "output": {"directory": str(tmp_path / "run"), "report": False}})
    own, _ = run_design(measured, out=tmp_path / "own", after=tmp_path / "run")
    without, _ = run_design(plan, out=tmp_path / "without", after=tmp_path / "run")
    _same(own, without)
    measured["design"] = {**plan["design"], "about": ["b"]}
    with pytest.raises(ConfigError, match=r"prior_correlation\.0: --after takes b from .*run; name the others"):
        run_design(measured, out=tmp_path / "part", after=tmp_path / "run")


def test_what_is_wanted_where_nothing_else_is_asked_for(tmp_path):
    plan = _plan(
        about=["a", "b"],
        wanted={"a": "50 %", "b": "0.001 m"},
        experiments=[1, 2],
        method="laplace",
        knobs={"every": {"key": "design.times.step", "values": ["0.2 s"]}},
    )
    run_design(plan, out=tmp_path / "out", overrides=PAGE)
    designs = load_designs(tmp_path / "out" / "design.nc")
    for row in designs.rows:
        assert row.evaluated.others.shape == (2, 0)
        assert needs(designs, row) == ["a to ± 50 %", "b to ± 0.001 m: not with these readings"]
    assert "as in the file; 1 experiment: a to ± 50 %" in design_table(designs)


def test_whole_fields_are_refused_with_what_to_do(tmp_path):
    plan = _plan(knobs={}, method="laplace", about=["recharge"])
    plan["model"] = {"name": "aquifer", "shape": [5, 5], "step": 2}
    del plan["design"]["times"]
    (tmp_path / "wells.csv").write_text("t,cell,head\n4,3,0.1\n4,20,0.1\n8,12,0.1\n")
    plan["data"] = {
        "path": str(tmp_path / "wells.csv"),
        "columns": {"time": {"name": "t", "unit": "1"}, "head": {"name": "head", "unit": "1"}},
        "places": {"column": "cell"},
        "error": {"head_std": "0.1"},
    }
    plan["parameters"] = {"recharge": {"prior": "lognormal", "median": 0.01, "log_std": 0.3}, "storage": 0.1}
    plan["initial_state"] = {"ln_T": {"std": 1, "kernel": "gaussian", "length": 2, "modes": 3}}
    localised = {"assimilation.localisation": {"radius": 3}}
    with pytest.raises(ConfigError, match=r"whole fields .* without assimilation\.localisation .* by its modes"):
        run_design(plan, out=tmp_path / "whole", overrides=localised)
    by_modes, _ = run_design(plan, out=tmp_path / "modes", overrides=PAGE)
    assert by_modes.rows[0].result.gain > 0
    page = (tmp_path / "modes" / "design.html").read_text()
    assert "3, at 4, 8" in page
    assert "<svg" not in page


@pytest.mark.parametrize(
    ("more", "what"),
    [
        ({"error": {"y_std": "0.3 m", "at_most": {"column": "limit"}}}, "errors in a column of the file"),
        ({"error": {"y_std": {"column": "std", "unit": "m"}}}, "errors in a column of the file"),
        ({"weights": {"column": "weight"}}, "weights of readings"),
    ],
)
def test_what_each_reading_says_of_itself_cannot_be_planned(more, what, tmp_path):
    plan = _plan()
    with pytest.raises(ConfigError, match=f"{what} cannot be planned at design.times; leave design.times out"):
        run_design(plan | {"data": plan["data"] | more}, out=tmp_path / "designs")


@pytest.mark.parametrize("command", [["design"], ["simulate", "--times", "0 us:10 us:1 us"]])
def test_a_prior_that_is_a_share_of_readings_yet_to_come_is_told_where_it_stands(command, tmp_path):
    share = "parameters.R_eq.median=12 % of maximum"
    plan = str(TESTS.parent / "configs" / "laser_design.yaml")
    done = CliRunner().invoke(main, [*command, plan, "--set", share, "--out", str(tmp_path / "x")])
    assert done.exit_code == 2
    assert "parameters.R_eq: takes a value from " in done.output
    assert "planned.csv: no such file" in done.output
    assert "; for an experiment to come, give a quantity" in done.output
