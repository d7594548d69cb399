"""``en4dvar.estimate``: a function, arrays and priors; the result is the one that a file and the command line give."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import xarray as xr
from toys import Linear

import en4dvar
from en4dvar.runs.checks import validate
from en4dvar.runs.rerun import rerun
from en4dvar_lorenz import Trend

TIMES = np.linspace(0.0, 3.0, 12)
NOISE = 0.1
SHAPE = np.cos(TIMES + 1 / 3)
VALUES = 1.0 + 0.5 * SHAPE + NOISE * np.random.default_rng(4).standard_normal(12)
PRIORS = {"a": {"prior": "normal", "mean": 0, "std": 2}, "b": {"prior": "normal", "mean": 0, "std": 1}}


def line(parameters: dict[str, float], times: Any) -> Any:
    """As toys.Linear: linear in its parameters."""
    return parameters["a"] + parameters["b"] * np.cos(times + 1 / 3)


def growth(parameters: dict[str, float], times: Any) -> Any:
    return {"y": parameters["a"] * np.exp(parameters["b"] * times)}


def fit(model: Any = line, data: Any = (TIMES, VALUES), priors: Any = PRIORS, **more: Any) -> en4dvar.Result:
    return en4dvar.estimate(model, data, priors, **{"error": NOISE, "progress": False, **more})


@pytest.fixture(scope="module")
def result() -> en4dvar.Result:
    return fit()


def test_a_linear_function_has_the_posterior_of_the_closed_form(result):
    design = np.stack([np.ones_like(TIMES), SHAPE], axis=1)
    precision = design.T @ design / NOISE**2 + np.diag([1 / 4, 1.0])
    mean = np.linalg.solve(precision, design.T @ VALUES / NOISE**2)
    members = result.to_dataframe()[["a", "b"]].to_numpy()
    np.testing.assert_allclose(members.mean(axis=0), mean, rtol=1e-8)
    np.testing.assert_allclose(np.cov(members.T), np.linalg.inv(precision), rtol=1e-6)


FORMS: dict[str, Any] = {
    "dict": {"time": TIMES.tolist(), "y": VALUES},
    "series": pd.Series(VALUES, index=TIMES),
    "frame with an index": pd.DataFrame({"y": VALUES}, index=TIMES),
    "frame with a column": pd.DataFrame({"y": VALUES, "time": TIMES}),
    "DataArray": xr.DataArray(VALUES, dims="t", coords={"t": TIMES}),
    "Dataset": xr.Dataset({"y": ("time", VALUES)}, coords={"time": TIMES}),
}


@pytest.mark.parametrize("form", FORMS)
def test_every_form_of_readings_gives_the_same_bits(form, result):
    assert fit(data=FORMS[form]).posterior.identical(result.posterior)


def test_errors_of_each_reading_columns_and_missing_readings(result):
    assert fit(error=np.full(12, NOISE)).posterior.identical(result.posterior)
    frame = pd.DataFrame({"t": [*TIMES, 3.5], "seen": [*VALUES, np.nan], "sd": NOISE})
    named = fit(data=frame, time="t", error={"seen_std": {"column": "sd"}})
    assert named.observable == "seen"
    np.testing.assert_array_equal(named.posterior["a"], result.posterior["a"])


IN_METRES = {
    "a": {"prior": "normal", "mean": "0 m", "std": "2 m"},
    "b": {"prior": "normal", "mean": "0 m", "std": "1 m"},
}


@pytest.mark.usefixtures("schemes_as_before")
def test_files_are_named_from_the_working_directory(tmp_path, monkeypatch, result):
    monkeypatch.chdir(tmp_path)
    np.savetxt("R.csv", NOISE**2 * np.eye(len(TIMES)), delimiter=",", fmt="%.17g")
    told = fit(error={"covariance": {"path": "R.csv", "unit": "1"}}).summary()
    np.testing.assert_allclose(told["mean"], result.summary()["mean"], rtol=1e-6)
    np.savetxt(
        "members.csv", np.random.default_rng(3).standard_normal((50, 2)), delimiter=",", header="a,b", comments=""
    )
    (tmp_path / "own.py").write_text("from en4dvar.schemes.filters import ETKF as Own\n", encoding="utf-8")
    priors = {name: {"prior": "ensemble", "map": "normal"} for name in "ab"}
    of_members = fit(priors=priors, prior={"ensemble": "members.csv"}, assimilation={"scheme": "./own.py:Own"})
    assert of_members.summary()["mean"].to_numpy() == pytest.approx(told["mean"].to_numpy(), abs=0.3)


def test_a_function_may_return_names_and_a_model_is_as_good(result):
    by_name = fit(lambda p, t: {"y": line(p, t), "other": t})
    assert by_name.posterior.identical(result.posterior)
    for model in (Linear, Linear(), {"name": "toys:Linear"}, "toys:Linear"):
        found = fit(model, priors=IN_METRES, error="0.1 m")
        np.testing.assert_allclose(found.posterior["b"], result.posterior["b"], rtol=1e-7)


def test_units_are_kept_and_numbers_fix_parameters():
    priors = {"a": "100 cm", "b": {"prior": "normal", "mean": "0 m/s", "std": "1 m/s"}}
    units = {"a": "m", "b": "m/s", "y": "m", "time": "s"}
    found = fit(priors=priors, units=units)
    assert list(found.posterior) == ["b"]
    assert found.posterior["b"].attrs["units"] == "m/s"
    assert found.observed_data["time"].attrs["units"] == "s"


def test_a_run_directory_is_that_of_the_command_line(tmp_path, result):
    run = tmp_path / "run"
    kept = fit(directory=run)
    assert kept.posterior.identical(result.posterior)
    assert (run / "report.html").is_file()
    assert en4dvar.load_result(run / "posterior.nc").posterior.identical(result.posterior)
    again = fit(directory=run, resume=True, report=False)
    assert again.posterior.identical(result.posterior)
    with pytest.raises(en4dvar.OutputError, match=r"data\.csv: holds other readings"):
        fit(data=(TIMES, VALUES + 1), directory=run)
    with pytest.raises(en4dvar.OutputError, match="cannot be resumed to the same result"):
        fit(growth, directory=run, resume=True)
    with pytest.raises(en4dvar.ConfigError, match="was handed over by a Python script; run that script again"):
        rerun(run)


def test_readings_of_somebody_else_are_not_replaced(tmp_path):
    (tmp_path / "data.csv").write_text("mine")
    with pytest.raises(en4dvar.OutputError, match="holds other readings"):
        fit(directory=tmp_path, force=True)
    assert (tmp_path / "data.csv").read_text() == "mine"


def test_a_result_is_saved_shown_and_compared(tmp_path, result):
    assert en4dvar.load_result(result.save(tmp_path / "line.nc")).posterior.identical(result.posterior)
    assert "<svg" in result.report(tmp_path / "line.html").read_text(encoding="utf-8")
    shown = result._repr_html_()
    assert f"{float(result.posterior['a'].mean()):.4g}" in shown
    compared = en4dvar.compare_runs({"line": result, "exponential": fit(growth), "file": tmp_path / "line.nc"})
    assert compared.verdict("data").startswith("undecidable: line and file differ by")
    with pytest.raises(en4dvar.ConfigError, match="no data set 'dta'; did you mean 'data'"):
        compared.verdict("dta")
    with pytest.raises(en4dvar.OutputError, match="at least two run directories"):
        en4dvar.compare_runs("runs/gel")
    with pytest.raises(en4dvar.ConfigError, match="no kind of table is called 'xls'; known: csv, latex, members"):
        en4dvar.export_table(tmp_path, "xls")
    for path in (tmp_path / "line", tmp_path / "line.html"):
        with pytest.raises(en4dvar.OutputError, match=r"ends in \.nc"):
            result.save(path)


def test_a_notebook_shows_names_escaped():
    found = fit(name="a", priors={"a": PRIORS["a"], "b": PRIORS["b"]}).with_attributes("/", dataset="<script>")
    assert "<script>" not in found._repr_html_()
    assert "&lt;script&gt;" in found._repr_html_()


FAULTS: dict[str, tuple[dict[str, Any], str]] = {
    "no model": ({"model": 3}, "model: int is neither a function nor a model"),
    "unknown model": ({"model": "bubbel"}, "unknown model 'bubbel'; did you mean 'bubble'"),
    "no data": ({"data": 3.0}, "data: float is none of: (times, values), a dict"),
    "no times": ({"data": {"t": TIMES, "y": VALUES}}, "data: no column 'time' of times; known: t, y; say which"),
    "lengths": ({"data": (TIMES, VALUES[:-1])}, "data: 'y' has shape (11,), but there are 12 times"),
    "dates": ({"data": (TIMES.astype("M8[s]"), VALUES)}, "data: 'time' holds dates; give elapsed time"),
    "words": ({"data": (TIMES, ["a"] * 12)}, "data: 'y' holds no numbers but 'a'"),
    "tables": ({"data": (TIMES, VALUES[:, None])}, "data: 'y' has shape (12, 1); give one number a time"),
    "no column of the model's": (
        {"model": "trend", "data": {"time": TIMES, "u": VALUES}, "priors": {"level": 0, "slope": 1}},
        "observable: call the column of readings what the model observes, one of: x",
    ),
    "two columns": ({"data": {"time": TIMES, "u": VALUES, "v": VALUES}}, "observable: name the column of readings"),
    "no such column": ({"observable": "z", "data": {"time": TIMES, "y": VALUES}}, "data: no column 'z'; the columns"),
    "no std": ({"error": 0.0}, "error.y_std: must be positive, not 0.0"),
    "odd error": ({"error": {"y_std": 0.1, "y_sd": 1.0}}, "error.y_sd: unknown key 'y_sd'; did you mean 'y_std'?"),
    "errors": ({"error": np.ones(3)}, "error: y_std has 3 numbers for 12 readings"),
    "errors of other times": (
        {"data": pd.Series(VALUES, TIMES), "error": pd.Series(np.ones(12), TIMES + 1)},
        "error: y_std has another index than the readings; align them",
    ),
    "errors of other rows": (
        {"data": pd.DataFrame({"y": VALUES}, TIMES), "observable": ["y"], "error": {"y": pd.Series(np.ones(12))}},
        "error: y: y_std has another index than the readings; align them",
    ),
    "no error column": ({"error": {"y_std": {"column": "sd"}}}, "data: no column 'sd'; the columns are: time, y"),
    "prior": ({"priors": {"a": {"prior": "flat"}}}, "priors.a.prior: 'flat' is not one of"),
    "prior unit": (
        {"units": {"a": "m"}, "priors": {"a": {**PRIORS["a"], "std": "2 m"}, "b": 1}},
        "priors.a.mean: 0 has no unit; write e.g. '0 m'",
    ),
    "odd unit": ({"units": {"c": "m"}}, "units: 'c' is neither a parameter in priors nor a column"),
    "unit unknown": ({"units": {"a": "1/mim"}}, "units: a: unknown unit 'mim'; did you mean 'mm' or 'min'?"),
    "units in a list": ({"units": ["a"]}, "units: give a dict, e.g. {'k': '1/s'}"),
    "number of a column": ({"observable": 1}, "observable: 1 is no name of a column; give a text, or a list of them"),
    "infinite": ({"data": (TIMES, np.where(TIMES > 2.9, np.inf, VALUES))}, "reading 12 of data: inf in column 'y'"),
    "name of a prior": ({"priors": {"a b": 1.0}}, "priors: 'a b' cannot be the name of a parameter"),
    "nothing estimated": ({"priors": {"a": 1.0, "b": 2.0}}, "nor is there initial_state or model_error; nothing"),
    "an object": ({"priors": {"a": {"prior": object}}}, "priors.a.prior: <class 'object'> is neither number, text"),
    "a null byte": ({"priors": {"a": {"prior": "no\0rmal"}}}, "priors.a.prior: a null byte"),
    "odd section": ({"asimilation": {}}, "asimilation: unknown key 'asimilation'; did you mean 'assimilation'?"),
    "setting": ({"assimilation": {"member": 3}}, "assimilation.member: unknown key 'member'; did you mean 'members'?"),
    "a time": ({"data": (np.where(TIMES > 2.9, np.nan, TIMES), VALUES)}, "time of reading 12 is NaN or masked"),
    "order": ({"data": (TIMES[::-1], VALUES)}, "reading 2 of data: times must increase, but 2.72727 follows 3;"),
    "repeated": ({"data": (TIMES.round(), VALUES)}, "follows 0; keep one of the two readings, or their mean"),
    "no parameter": ({"priors": {"reading_scale": PRIORS["a"]}}, "priors: none is of a parameter of the function"),
    "members": ({"assimilation": {"members": 10**9}}, "assimilation.members: should be less than or equal to 100000"),
    "early": ({"data": (TIMES - 2, VALUES)}, "the first observation used lies 2 before time zero, where the model's"),
    "window": ({"window": {"form": 1}}, "window.form: unknown key 'form'; did you mean 'from'?"),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_each_fault_is_one_message_with_its_argument(fault):
    arguments, words = FAULTS[fault]
    with pytest.raises((en4dvar.ConfigError, en4dvar.DataError)) as caught:
        fit(**arguments)
    assert words in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1
    assert not re.search(r"data\.|/tmp", str(caught.value))


@pytest.mark.parametrize(
    ("function", "reason"),
    [
        (lambda p, t: p["c"] + t, "KeyError: 'c'"),
        (lambda p, t: t[1:], "the function returned shape (11,) for y, expected (12,), one per time"),
        (lambda p, t: {"z": t}, "the function returned z, but no 'y'"),
        (lambda p, t: None, "the function returned shape () for y"),
        (lambda p, t: t * np.nan, "non-finite prediction"),
        (lambda p, t: p["a"] + 1j * t, "the function returned complex numbers for y"),
    ],
)
def test_what_is_wrong_with_a_function_is_told(function, reason):
    with pytest.raises(en4dvar.TooFewMembersError) as caught:
        fit(function)
    assert reason in str(caught.value)


@pytest.mark.parametrize(
    "name", ["chain", "dataset", "draw", "posterior_draw", "iteration", "J", "J_background", "dfs"]
)
def test_a_name_that_the_result_has_itself_is_refused_before_anything_is_computed(name):
    runs = []

    def model(parameters, times):
        runs.append(parameters)
        return line({"a": parameters[name], "b": 0.0}, times)

    with pytest.raises(en4dvar.ConfigError, match=f"the parameter '{name}' needs another name: the result has another"):
        fit(model, priors={name: PRIORS["a"]})
    assert not runs


@pytest.mark.parametrize("name", ["a" * 300, "é" * 150])
def test_a_name_that_is_too_long_for_a_variable_is_refused(name):
    with pytest.raises(en4dvar.ConfigError, match="is too long for a variable of the result"):
        fit(lambda p, t: p[name] + 0 * t, priors={name: PRIORS["a"]})
    with pytest.raises(en4dvar.ConfigError, match="is too long for a variable of the result"):
        fit(lambda p, t: line(p, t), data={"time": TIMES, name: VALUES})


@pytest.mark.parametrize("names", [("y", "y_std"), ("y", "y_weights"), ("y", "y_path"), ("y", "y_time"), ("weights",)])
def test_a_series_that_is_called_as_what_is_read_together_with_it_is_refused(names):
    """Its readings would be taken for errors, weights or times, or those for its readings."""
    data = {name: {"time": TIMES, name: VALUES} for name in names}
    single = {"data": data[names[0]], "error": 0.1}
    asked = {"data": data, "error": dict.fromkeys(names, 0.1)} if len(names) > 1 else single
    with pytest.raises(en4dvar.ConfigError, match=f"needs another name: the result has another '{names[-1]}'"):
        fit(lambda p, t: dict.fromkeys(names, line(p, t)), **asked)


@pytest.mark.parametrize("name", ["e\u0301", "\u2126"])  # é of two characters, the sign of the ohm
def test_a_name_that_a_file_would_spell_otherwise_is_refused(name):
    with pytest.raises(en4dvar.ConfigError, match=r"parameter .* needs another name: netCDF spells .*; write it so"):
        fit(lambda p, t: p[name] + 0 * t, priors={name: PRIORS["a"]})


def test_names_that_collide_with_each_other_are_refused(tmp_path):
    with pytest.raises(en4dvar.ConfigError, match="'a' needs another name: the result has another 'a_centre'"):
        fit(lambda p, t: p["a"] + p["a_centre"] * t, priors={"a": PRIORS["a"], "a_centre": PRIORS["b"]})
    with pytest.raises(en4dvar.ConfigError, match="the series 'mode' needs another name: the result has another 'mode"):
        fit(lambda p, t: line(p, t), data={"time": TIMES, "mode": VALUES})
    model = "class Creep(Linear):\n    def __init__(self):\n        super().__init__('Jb')\n"
    (tmp_path / "creep.py").write_text(f"from toys import Linear\n{model}")
    (tmp_path / "x.csv").write_text("t,y\n0,1\n1,2\n2,2\n")
    asked = {
        "name": "x",
        "model": {"name": f"{tmp_path}/creep.py:Creep"},
        "data": {
            "path": f"{tmp_path}/x.csv",
            "columns": {"time": {"name": "t", "unit": "s"}, "y": {"name": "y", "unit": "m"}},
            "error": {"y_std": "0.1 m"},
        },
        "parameters": {"J": IN_METRES["a"], "b": IN_METRES["b"]},
    }
    with pytest.raises(en4dvar.ConfigError, match="the parameter 'J' needs another name"):
        validate(asked)


def test_a_function_cannot_vary_in_time():
    varying = {**PRIORS, "b": {**PRIORS["b"], "varies": {"every": 1, "std": 0.1}}}
    with pytest.raises(en4dvar.ConfigError, match=r"priors\.b\.varies: b cannot vary: the model has no step"):
        fit(priors=varying)


class Neither(en4dvar.ForwardModel):
    parameters, observables = (), ()

    def initial_state(self, theta: Any) -> Any:
        return np.zeros(1)


def test_a_model_has_a_step_or_trajectories():
    with pytest.raises(TypeError, match="Neither has neither step nor trajectories; write one of them"):
        Neither()


def test_a_dict_is_run_as_the_file_of_it(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    pd.DataFrame({"t": TIMES, "v": VALUES}).to_csv("line.csv", index=False)
    content = {
        "name": "line",
        "model": {"name": "toys:Linear"},
        "data": {
            "path": Path("line.csv"),
            "columns": {"time": {"name": "t", "unit": "s"}, "y": {"name": "v", "unit": "m"}},
            "error": {"y_std": "0.1 m"},
        },
        "parameters": IN_METRES,
        "seed": np.int64(3),
        "output": {"report": False},
    }
    found = en4dvar.run(content)
    written = Path("runs/line/config.yaml")
    written.rename("line.yaml")
    assert en4dvar.run("line.yaml", force=True).posterior.identical(found.posterior)
    assert en4dvar.validate(content).name == "line"
    with pytest.raises(en4dvar.ConfigError, match=r"data\.error\.y_std: must be positive"):
        en4dvar.run({**content, "data": {**content["data"], "error": {"y_std": "0 m"}}})


def test_a_star_gives_the_public_names():
    names: dict[str, object] = {}
    exec("from en4dvar import *", names)
    assert [names[name] for name in ("estimate", "run", "Prior")] == [en4dvar.estimate, en4dvar.run, en4dvar.Prior]
    assert set(en4dvar.__all__) <= set(dir(en4dvar))


def test_a_function_hears_of_each_iteration():
    heard = []
    result = fit(progress=lambda name, record: heard.append((name, record)))
    assert {name for name, _ in heard} == {"data"}  # the file that the arrays are kept in
    costs = [record.cost for _, record in heard if hasattr(record, "cost")]
    assert len(costs) >= 2
    assert costs[-1] < costs[0]
    assert len(result.summary()) == 2


@pytest.mark.parametrize("section", ["trend", {"name": "trend"}])
def test_values_without_a_name_are_what_a_model_named_observes(section):
    """As of the model itself: its first observable."""
    prior = {"level": {"prior": "normal", "mean": 0, "std": 1}, "slope": 1}
    named = en4dvar.estimate(section, (TIMES, VALUES), prior, error=0.1, progress=False)
    handed = en4dvar.estimate(Trend, (TIMES, VALUES), prior, error=0.1, progress=False)
    np.testing.assert_allclose(named.posterior["level"], handed.posterior["level"], rtol=1e-9)


def test_a_model_may_declare_its_observables_in_a_list():
    model = Trend()
    model.observables = list(model.observables)
    assert fit(model, priors={"level": PRIORS["a"], "slope": 0.0}).observable == "x"


def test_a_warning_shows_a_time_without_a_unit_as_a_number():
    result = fit(data=([0.0, *TIMES + 0.35], [40.0, *VALUES]))
    told = "\n".join(map(str, result.warnings))
    assert "frames of 0.2727, the first from 0 to 0.35: is a time wrong?" in told
    assert "the reading at 0 on the clock of the data" in told


def test_a_directory_that_is_not_empty_is_told_in_arguments_of_the_function(tmp_path):
    """In its name ``--force`` was written as ``force=True``."""
    fit(directory=tmp_path / "a--force")
    words = r"a--force: .+; force=True replaces it, the directory \S+a--force_2 keeps both$"
    with pytest.raises(en4dvar.OutputError, match=words):
        fit(directory=tmp_path / "a--force")
