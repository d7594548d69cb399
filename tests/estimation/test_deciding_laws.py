"""Which law holds: against closed-form evidences, for laws that are the same, and as a command."""

from __future__ import annotations

import csv

import numpy as np
import pytest
from scipy.stats import multivariate_normal
from toys import Vectorised, make_observations

from en4dvar.estimation.design.nested import Decision, deciding
from en4dvar.estimation.design.planned import Planned
from en4dvar.plumbing.errors import ConfigError
from en4dvar.priors.prior import Prior, PriorTerm
from en4dvar.problem import InverseProblem
from en4dvar.results.design_file import load_designs
from en4dvar.runs.design_run import run_design

TIMES = np.linspace(0.1, 2.5, 6)


def _law(std, names=("a", "b"), spread=1.0):
    model = Vectorised(names=names)
    terms = tuple(PriorTerm.normal(p, 0.4, spread) for p in model.parameters)
    data = make_observations(TIMES, np.zeros(len(TIMES)), std=std)
    return Planned(InverseProblem(model, model.observables[0], data, Prior(terms)))


def _evidence(law, std):
    """ln p(y) as a function, from N(H m, H B Hᵀ + R)."""
    terms = law.problem.prior.terms
    j = np.arange(len(terms))
    H = np.cos(TIMES[:, None] * j + j**2 / 3)
    B = np.diag([t.std**2 for t in terms])
    return multivariate_normal(H @ [t.mean for t in terms], H @ B @ H.T + std**2 * np.eye(len(TIMES)))


@pytest.mark.parametrize("std", [pytest.param(std, marks=pytest.mark.slow) for std in (2.0, 0.6, 0.1)])
def test_against_evidences_in_closed_form(std):
    """Two and three parameters: what 200 000 readings of each, explained exactly, tell."""
    laws = [_law(std), _law(std, ("a", "b", "c"))]
    found = deciding(laws, 60, 100, 1)
    exact, rng = [_evidence(law, std) for law in laws], np.random.default_rng(0)
    readings = [one.rvs(200_000, rng) for one in exact]
    truth = Decision.of([np.column_stack([one.logpdf(y) for one in exact]) for y in readings])
    assert found.information == pytest.approx(truth.information, abs=3 * found.information_error)
    assert found.probability == pytest.approx(truth.probability, abs=3 * found.probability_error)
    assert found.decided == pytest.approx(truth.decided, abs=3 * found.decided_error)
    assert found.information_error < 0.08
    assert found.thin == 0


def test_laws_that_are_the_same_cannot_be_told_apart():
    found = deciding([_law(0.3), _law(0.3), _law(0.3)], 4, 60, 1)
    assert found.probability == pytest.approx(1 / 3, abs=0.01)
    assert found.information == pytest.approx(0, abs=0.005)
    assert found.decided == 0


def test_laws_that_are_far_apart_always_are():
    found = deciding([_law(0.01), _law(0.01, ("a", "b", "c", "d"))], 5, 60, 1)
    assert found.probability > 0.98
    assert found.information == pytest.approx(np.log(2), abs=0.04)
    assert found.decided_error > 0


def test_errors_of_evidences_cancel_in_the_information():
    """Readings that tell 0.35 nats; errors of 0.3 in their log-evidences change that by less than 0.005."""
    rng = np.random.default_rng(1)
    logs = [np.stack([rng.normal(1.5, np.sqrt(3), 100_000), np.zeros(100_000)], axis=1)[:, ::s] for s in (1, -1)]
    clean = Decision.of(logs)
    rough = Decision.of([one + 0.3 * rng.standard_normal(one.shape) for one in logs])
    assert 0.25 < clean.information < 0.45
    assert rough.information == pytest.approx(clean.information, abs=0.005)


def _plan(**design):
    return {
        "name": "which",
        "model": {"name": "toys:Vectorised"},
        "data": {
            "path": "not yet measured.csv",
            "columns": {"time": {"name": "t", "unit": "s"}, "y": {"name": "y", "unit": "m"}},
            "error": {"y_std": "0.3 m"},
        },
        "parameters": {"a": {"prior": "normal", "mean": "1 m", "std": "0.5 m"}, "b": "0 m"},
        "design": {
            "times": {"from": "0.1 s", "to": "2.5 s", "step": "0.4 s"},
            "knobs": {"error": {"key": "data.error.y_std", "values": ["0.1 m", "3 m"]}},
            "laws": {"constant": {}, "cosine": {"parameters.b": {"prior": "normal", "mean": "0 m", "std": "1 m"}}},
            "draws": 20,
            "simulated": 20,
            "inner": 50,
            **design,
        },
    }


@pytest.mark.slow
def test_as_a_command(tmp_path):
    """A key that differs is a law; designs are ranked by what they tell of it, in every file."""
    found, directory = run_design(_plan(), out=tmp_path / "out")
    again = load_designs(directory / "design.nc")
    told = {tuple(row.settings.values()): row.result.decision for row in again.rows}
    assert told == {tuple(row.settings.values()): row.result.decision for row in found.rows}
    assert told["0.1 m",].probability > 0.8 > 0.6 > told["3 m",].probability
    rows = list(csv.DictReader((directory / "designs.csv").read_text().splitlines()))
    assert [row["error"] for row in rows] == ["0.1 m", "", "3 m"]
    assert float(rows[0]["law_information"]) == told["0.1 m",].information
    page = (directory / "design.html").read_text()
    assert "which law holds, constant or cosine" in page
    assert "the law in " in page


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"laws": {"one": {}}}, "nothing to be told from"),
        ({"laws": {"one": {}, "two": {"data.error.y_std": "1 m"}}}, r"two.data.error.y_std.*laws share the experiment"),
        ({"laws": {"one": {}, "two": {"parameters.zz": "1 m"}}}, "zz"),
        ({"experiments": [4]}, "not with laws"),
    ],
)
def test_bad_input(tmp_path, change, message):
    with pytest.raises(ConfigError, match=message):
        run_design(_plan(**change), out=tmp_path / "out")
