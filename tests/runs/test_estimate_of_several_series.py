"""``en4dvar.estimate`` of several observables at once: closed forms, forms of readings, and faults."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
import pytest
import xarray as xr
from problem.series_models import Two

import en4dvar
from en4dvar.inputs import text_table

RNG = np.random.default_rng(3)
T1, T2 = np.linspace(0.1, 1.0, 7), np.linspace(0.3, 1.5, 9)
S1, S2 = 0.3, np.linspace(0.1, 0.3, 9)
V1 = 1 + 0.5 * T1 + S1 * RNG.standard_normal(7)
V2 = 2 - 0.5 * T2**2 + S2 * RNG.standard_normal(9)
DATA = {"p": (T1, V1), "q": (T2, V2)}
ERROR = {"p": S1, "q": S2}
PRIORS = {name: {"prior": "normal", "mean": 0.3, "std": 2} for name in "ab"}


def two(parameters: dict[str, float], times: Any) -> Any:
    """The observables of series_models.Two."""
    a, b = parameters["a"], parameters["b"]
    return {"p": a + b * times, "q": 2 * a - b * times**2}


def fit(model: Any = two, data: Any = None, **more: Any) -> en4dvar.Result:
    given = {"priors": PRIORS, "error": ERROR, "progress": False, **more}
    return en4dvar.estimate(model, DATA if data is None else data, **given)


def test_a_reading_is_counted_in_its_series():
    with pytest.raises(en4dvar.DataError, match=r"reading 3 of q: times must increase, but 0\.3 follows 0\.45;"):
        fit(data={**DATA, "q": (np.where(T2[2] == T2, T2[0], T2), V2)})


def test_a_file_of_series_is_as_long_as_the_longest_and_parsed_once(tmp_path):
    """Rows stood below each other, and each series parsed all: time grew with the third power of their number."""
    text_table._parted.cache_clear()
    fit(directory=tmp_path / "run", report=False)
    lines = (tmp_path / "run" / "data.csv").read_text().splitlines()
    assert len(lines) == 1 + max(len(T1), len(T2))
    assert text_table._parted.cache_info().misses <= len(lines)


@pytest.mark.parametrize("several", [True, False])
def test_a_covariance_loses_the_rows_of_missing_readings(several):
    seen = np.isin(np.arange(9), (0, 4), invert=True)
    R2 = np.outer(S2, S2) * 0.5 ** np.abs(np.subtract.outer(range(9), range(9)))
    q = (T2, np.where(seen, V2, np.nan))
    R, rows = R2[seen][:, seen], design(t2=T2[seen])
    if several:
        found = fit(data={"p": DATA["p"], "q": q}, error={"p": S1, "q": {"covariance": R2}})
        R = np.block([[S1**2 * np.eye(7), np.zeros((7, 7))], [np.zeros((7, 7)), R]])
        assert_closed_form(found, rows, np.concatenate([V1, V2[seen]]), R)
    else:
        found = fit(lambda p, t: two(p, t)["q"], q, error={"covariance": R2})
        assert_closed_form(found, rows[7:], V2[seen], R)
    with pytest.raises(en4dvar.DataError, match=r"covariance has shape \(8, 8\) for 9 readings"):
        fit(lambda p, t: two(p, t)["q"], q, error={"covariance": R2[1:, 1:]})


@pytest.fixture(scope="module")
def result() -> en4dvar.Result:
    return fit()


def design(t1: Any = T1, t2: Any = T2) -> Any:
    return np.vstack([np.column_stack([np.ones_like(t1), t1]), np.column_stack([np.full_like(t2, 2.0), -(t2**2)])])


def assert_closed_form(found: en4dvar.Result, G: Any, y: Any, R: Any) -> None:
    precision = G.T @ np.linalg.solve(R, G) + np.eye(2) / 4
    mean = np.linalg.solve(precision, G.T @ np.linalg.solve(R, y) + 0.3 / 4)
    members = found.to_dataframe()[["a", "b"]].to_numpy()
    np.testing.assert_allclose(members.mean(axis=0), mean, rtol=1e-8)
    np.testing.assert_allclose(np.cov(members.T), np.linalg.inv(precision), rtol=1e-6)


def test_two_observables_at_times_of_their_own_have_the_posterior_of_the_closed_form(result):
    R = np.diag(np.concatenate([np.full(7, S1), S2]) ** 2)
    assert_closed_form(result, design(), np.concatenate([V1, V2]), R)
    np.testing.assert_array_equal(result.observed_data["p_time"], T1)
    np.testing.assert_array_equal(result.observed_data["q_time"], T2)


def test_the_function_is_asked_for_the_union_of_the_times():
    asked = []

    def noted(parameters, times):
        asked.append(times)
        return two(parameters, times)

    fit(noted)
    union = np.unique(np.concatenate([T1, T2]))
    assert all(np.array_equal(times, union) for times in asked)


def test_correlated_errors_at_equal_times():
    data = {"p": (T1, V1), "q": (T1, V2[:7])}
    found = fit(data=data, error={"p": 0.3, "q": 0.2}, correlation={"p": {"q": 0.6}})
    R = np.kron([[0.09, 0.6 * 0.06], [0.6 * 0.06, 0.04]], np.eye(7))
    assert_closed_form(found, design(T1, T1), np.concatenate([V1, V2[:7]]), R)


FORMS: dict[str, Any] = {
    "dicts": {"p": {"time": T1, "p": V1}, "q": {"time": T2.tolist(), "seen": V2}},
    "Series": {"p": pd.Series(V1, index=T1), "q": pd.Series(V2, index=T2, name="seen")},
    "DataArrays": {name: xr.DataArray(v, dims="t", coords={"t": t}) for name, (t, v) in DATA.items()},
    "mixed": {"p": pd.DataFrame({"p": V1}, index=T1), "q": xr.Dataset({"q": ("time", V2)}, coords={"time": T2})},
}


@pytest.mark.parametrize("form", FORMS)
def test_every_form_gives_the_same_bits(form, result):
    assert fit(data=FORMS[form]).posterior.identical(result.posterior)


@pytest.mark.parametrize("kind", [pd.DataFrame, dict, xr.Dataset.from_dataframe])
def test_columns_of_one_table(kind, result):
    table = pd.DataFrame(
        {"time": [*T1, *T2], "p": [*V1, *[np.nan] * 9], "q": [*[np.nan] * 7, *V2], "sd": [*[S1] * 7, *S2]}
    )
    data = kind(table) if kind is not xr.Dataset.from_dataframe else kind(table.set_index("time"))
    error = {"p": 0.3, "q": {"q_std": {"column": "sd"}}}
    assert fit(data=data, observable=table.columns[1:3], error=error).posterior.identical(result.posterior)


def in_units(**more: Any) -> dict[str, Any]:
    return {"error": {"p": 0.3, "q": S2, **more}}


def test_a_forward_model_and_its_field(result):
    found = fit(Two, **in_units())
    np.testing.assert_allclose(found.posterior["a"], result.posterior["a"], rtol=1e-6)
    at, cells = (
        np.array([0.0, 2.0, 3.5, 6.0]),
        pd.DataFrame({"time": 0.5, "x": [0.0, 2.0, 3.5, 6.0], "f": [0.2, 2, 4, 6]}),
    )
    heads = {"observable": "f", "places": {"column": "x", "unit": "m"}, "weights": [1, 1, 0, 1]}
    wells = fit(Two, {**DATA, "wells": cells}, **in_units(wells=0.5), series={"wells": heads})
    used = np.array([0, 1, 3])
    G = np.vstack([design(), np.column_stack([at, np.full(4, 0.5)])[used]])
    R = np.diag(np.concatenate([np.full(7, S1), S2, np.full(3, 0.5)]) ** 2)
    assert_closed_form(wells, G, np.concatenate([V1, V2, cells["f"].to_numpy()[used]]), R)


@pytest.mark.slow
def test_units_and_a_run_directory(tmp_path):
    units = {"time": "s", "p": "m", "q": "cm", "a": "m", "b": "m/s"}
    priors = {
        "a": {"prior": "normal", "mean": "0.3 m", "std": "2 m"},
        "b": {"prior": "normal", "mean": "0.3 m/s", "std": "2 m/s"},
    }
    run = tmp_path / "run"
    kept = fit(units=units, priors=priors, directory=run)
    assert kept.observed_data["q"].attrs["units"] == "cm"
    assert (run / "report.html").is_file()
    assert fit(units=units, priors=priors, directory=run, resume=True, report=False).posterior.identical(kept.posterior)
    with pytest.raises(en4dvar.OutputError, match=r"data\.csv: holds other readings"):
        fit(data={"p": (T1, V1), "q": (T2, V2 + 1)}, units=units, priors=priors, directory=run)


FAULTS: dict[str, tuple[dict[str, Any], str]] = {
    "no table": ({"data": {"p": (T1, V1), "q": V2}}, "data: no column 'time' of times; known: p, q"),
    "lengths": ({"data": {"p": (T1, V1[:-1]), "q": (T2, V2)}}, "data: p: 'p' has shape (6,), but there are 7 times"),
    "no times": ({"data": {"p": (T1, V1), "q": {"q": V2}}}, "data: q: no column 'time' of times"),
    "which column": (
        {"data": {"p": (T1, V1), "q": {"time": T2, "u": V2, "v": V2}}},
        "data: q: which column holds the readings? Call it 'q'",
    ),
    "no such column": (
        {"data": {"time": T1, "p": V1}, "observable": ["p", "q"]},
        "data: no column 'q'; the columns are",
    ),
    "one error": ({"error": 0.1}, "error: give a dict with one for each series: p, q"),
    "no error": ({"error": {"p": 0.1}}, "error: none for 'q'; give one for each series: p, q"),
    "odd error": ({"error": {**ERROR, "pp": 1}}, "error: no series 'pp' in data; did you mean 'p'?"),
    "negative": ({"error": {"p": -0.1, "q": 1}}, "error.p.p_std: must be positive, not -0.1"),
    "errors": ({"error": {"p": np.ones(3), "q": 1}}, "error: p: p_std has 3 numbers for 7 readings"),
    "error column": ({"error": {"p": {"p_std": {"column": "sd"}}, "q": 1}}, "data: p: no column 'sd'; the columns"),
    "observable": ({"observable": "p"}, "observable: of several series each says its own"),
    "name": ({"data": {"p q": (T1, V1)}, "error": {"p q": 1}}, "series.p q: 'p q' cannot be the name of a series"),
    "model": ({"model": Two, "data": {"r": (T1, V1)}, "error": {"r": 1}}, "data: r: the model has no 'r'; it has: p"),
    "section": ({"series": {"r": {}}}, "series: no series 'r' in data; known: p, q"),
    "no section": ({"series": {"p": 3}}, "series: p: give a dict"),
    "key": ({"series": {"p": {"wights": [1]}}}, "series.p.wights: unknown key 'wights'; did you mean 'weights'?"),
    "weights": ({"series": {"p": {"weights": [1.0]}}}, "7 observations of the window; what is missing (NaN)"),
    "correlation": ({"correlation": {"p": {"r": 0.5}}}, "correlation.p.r: no other series 'r'"),
    "alone": ({"data": (T1, V1), "error": 1, "correlation": {"p": {"q": 0.5}}}, "correlation: data is one series"),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_each_fault_is_one_message_with_its_argument(fault):
    arguments, words = FAULTS[fault]
    with pytest.raises((en4dvar.ConfigError, en4dvar.DataError)) as caught:
        fit(**arguments)
    assert words in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1


def test_what_a_function_does_not_return_is_told():
    with pytest.raises(en4dvar.TooFewMembersError, match="the function returned p, but no 'q'"):
        fit(lambda p, t: {"p": t})
    with pytest.raises(en4dvar.TooFewMembersError, match="the function returned one array, but p and q were observed"):
        fit(lambda p, t: t)
