"""``start: {from: …}``: the one descent goes from there, and the prior stays as it is."""

from pathlib import Path

import numpy as np
import pytest
from run_files import configuration, make_campaign

import en4dvar
from en4dvar.config import load_config
from en4dvar.config.context import Context
from en4dvar.config.document import parse_document
from en4dvar.config.load import values_of
from en4dvar.config.parameters import Uncertain
from en4dvar.config.schema import GivenStart
from en4dvar.inputs.members import read_centres
from en4dvar.model.state import Parameter
from en4dvar.plumbing.tables import write_csv
from en4dvar.runs.runner import run_campaign

TIMES = np.linspace(0.1, 2.0, 12)
PRIORS = {"a": {"prior": "normal", "mean": 0.3, "std": 1.5}, "b": {"prior": "lognormal", "median": 1.0, "log_std": 0.5}}


def square(parameters, times):
    """The sign of a cannot be told: minima near a = 1.2 and a = −1.2, the latter less likely by the prior."""
    return parameters["a"] ** 2 * np.exp(-parameters["b"] * times)


def fit(start, priors=PRIORS, directory=None, **more):
    values = 1.44 * np.exp(-0.8 * TIMES) + 0.05 * np.random.default_rng(3).standard_normal(12)
    settings = {"start": start, "refine": "none", "what_if": False, **more}
    options = {"error": 0.05, "report": False, "progress": False, "directory": directory}
    return en4dvar.estimate(square, (TIMES, values), priors, assimilation=settings, **options)


def cost(a, b):
    """J by hand, of the formulas of the priors and of Gaussian errors."""
    values = 1.44 * np.exp(-0.8 * TIMES) + 0.05 * np.random.default_rng(3).standard_normal(12)
    misfit = (values - square({"a": a, "b": b}, TIMES)) / 0.05
    return 0.5 * (((a - 0.3) / 1.5) ** 2 + (np.log(b) / 0.5) ** 2 + misfit @ misfit)


@pytest.mark.parametrize(("at", "sign"), [(0.9, 1), (1.8, 1), (-0.9, -1), (-1.8, -1)])
def test_it_ends_in_the_minimum_of_its_start(at, sign):
    found = fit({"from": {"a": at}})
    centre = found.summary()["centre"]
    a, b = centre["a"], centre["b"]
    assert np.sign(a) == sign
    assert abs(a) == pytest.approx(1.2, abs=0.1)
    least = cost(a, b)
    assert all(cost(a + da, b * fb) > least for da, fb in ((0.02, 1), (-0.02, 1), (0, 1.02), (0, 0.98)))
    (alone,) = [c for c in found.cautions if c.code == "one-descent"]
    assert alone.advice == "set assimilation.start: best-member"
    assert not any(c.code == "one-descent" for c in fit("best-member").cautions)


def test_the_prior_does_not_change():
    near, far = (fit({"from": {"a": at, "b": 1.4}}).summary() for at in (1.0, 1.6))
    for column in ("prior_mean", "prior_std"):
        assert near[column].tolist() == far[column].tolist()
    assert near["centre"].to_numpy() == pytest.approx(far["centre"].to_numpy(), rel=1e-4)
    assert near["std"].to_numpy() == pytest.approx(far["std"].to_numpy(), rel=1e-3)


def test_from_an_earlier_result(tmp_path):
    fit({"from": {"a": -1.0}}, directory=tmp_path / "before")
    (file,) = (tmp_path / "before").rglob("posterior.nc")
    assert fit({"from": str(file)}).summary()["centre"]["a"] == pytest.approx(-1.2, abs=0.1)
    content = bytearray(file.read_bytes())
    content[len(content) // 2 :] = b""
    damaged = tmp_path / "damaged.nc"
    damaged.write_bytes(content)
    for bad, words in ((damaged, "damaged.nc"), (tmp_path / "none.nc", "none.nc"), (tmp_path, str(tmp_path))):
        told(bad, words)
    foreign = tmp_path / "foreign.csv"
    foreign.write_text("c,d\n1,2\n3,4\n")
    told(foreign, "no column 'a'")


def test_a_campaign_starts_from_its_neighbours(tmp_path):
    """From where those of the same name ended before, or of the name before it; the minima are the same."""
    path = make_campaign(tmp_path, 3)
    before = run_campaign(configuration(path, tmp_path / "before"))
    rows = (tmp_path / "before" / "summary.csv").read_text(encoding="utf-8").splitlines(keepends=True)
    summary = tmp_path / "summary.csv"
    summary.write_text("".join(row for row in rows if not row.startswith("set1")), encoding="utf-8")
    again = {"assimilation.start": {"from": str(summary)}, "output.directory": str(tmp_path / "again")}
    again["output.report"] = False
    assert load_config(path, again).assimilation.start.keys() == {"set0", "set2"}
    for earlier, later in zip(before, run_campaign(load_config(path, again)), strict=True):
        assert later.sample_stats.attrs["forward_runs"] < earlier.sample_stats.attrs["forward_runs"]
        near, far = (result.summary()["centre"].to_numpy() for result in (later, earlier))
        assert near == pytest.approx(far, rel=1e-3)
    whole = summary.read_text(encoding="utf-8")
    summary.write_text(whole.replace(",A,", ",B,").replace(",k,", ",K,"), encoding="utf-8")
    with pytest.raises(en4dvar.ConfigError, match=r"start.from: .*: no data set has A, k"):
        load_config(path, again)


def test_names_that_a_spreadsheet_would_take_for_formulas(tmp_path):
    names = ("-10C", "+5C", "'x", "20C")
    rows = [("dataset", "name", "unit", "centre"), *((name, "k", "N/m", 2.0) for name in names)]
    assert read_centres(write_csv(tmp_path / "summary.csv", rows), {"k": "N/m"}) == {n: {"k": 2.0} for n in names}


def told(start, words):
    with pytest.raises(en4dvar.ConfigError) as caught:
        fit({"from": str(start)})
    assert words in str(caught.value)
    assert "assimilation.start.from" in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1


FAULTS = {
    "a stranger": ({"from": {"c": 1.0}}, "assimilation.start.from.c: not estimated"),
    "a unit": ({"from": {"a": "1 Pa"}}, "assimilation.start.from.a: "),
    "outside the prior": ({"from": {"b": -1.0}}, "assimilation.start.from.b: "),
    "nothing": ({"from": {}}, "assimilation.start.from"),
    "another key": ({"at": {"a": 1.0}}, "assimilation.start"),
    "another word": ("somewhere", "assimilation.start"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_what_is_wrong_is_told_where(fault):
    start, words = FAULTS[fault]
    with pytest.raises(en4dvar.ConfigError) as caught:
        fit(start)
    assert words in str(caught.value)


def test_a_scheme_that_does_not_search_has_no_start():
    with pytest.raises(en4dvar.ConfigError, match="start"):
        fit({"from": {"a": 1.0}}, scheme="es-mda")


def test_the_resolved_configuration_starts_there_again(tmp_path):
    quick = Path(__file__).parents[2] / "configs" / "quickstart.yaml"
    asked = {"assimilation.start": {"from": {"G": "2 kPa", "mu": "0.2 Pa s"}}}
    config = load_config(quick, asked)
    assert config.assimilation.start == pytest.approx({"G": 2000.0, "mu": 0.2})
    (tmp_path / "again.yaml").write_text(config.resolved, encoding="utf-8")
    assert load_config(tmp_path / "again.yaml").assimilation == config.assimilation


def test_a_relative_file_lies_beside_the_configuration_and_is_recorded_in_full(tmp_path):
    (tmp_path / "before.csv").write_text("a,b\n0.9,1.1\n1.1,1.2\n1.0,1.6\n", encoding="utf-8")
    section = GivenStart.model_validate({"from": "before.csv"}, context=Context(tmp_path))
    assert section.as_written({"from": "before.csv"}) == {"from": str(tmp_path / "before.csv")}
    read = {name: Uncertain(Parameter(name, "1"), spec=None) for name in ("a", "b")}
    assert values_of(section, tuple(read.values()), parse_document("name: x")) == {"a": 1.0, "b": 1.2}
