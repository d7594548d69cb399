"""Tied parameters: one value in several places."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from toy_config import write_toy
from toys import Vectorised, make_problem

from en4dvar.assembly.build import build
from en4dvar.config import load_config
from en4dvar.estimation.assimilate import assimilate
from en4dvar.plumbing.errors import ConfigError
from en4dvar.priors.prior import Prior
from en4dvar.problem import Tie
from en4dvar.results.store import build_groups
from en4dvar.runs.simulation import simulate
from en4dvar.schemes.settings import AssimilationSettings

FACTOR = -1.7


def pair():
    """Of three parameters the third follows the first: estimated (a, b)."""
    problem = make_problem(Vectorised(("a", "b", "c")), [1.0, 0.5, FACTOR], std=0.2)
    c = problem.model.parameters[2]
    return replace(problem, prior=Prior(problem.prior.terms[:2]), tied=(Tie(c, "a", FACTOR),))


@pytest.mark.parametrize("linearisation", ["bundle", "transform"])
def test_the_reduced_linear_problem(linearisation):
    problem = pair()
    found = assimilate(problem, AssimilationSettings(members=12, linearisation=linearisation), 1)
    times, prior = problem.observations.times, problem.prior
    j = np.arange(3)
    h = np.cos(j * times[:, None] + j**2 / 3) @ np.array([[1, 0], [0, 1], [FACTOR, 0]])
    precision = np.diag(prior.std**-2) + h.T @ h / 0.2**2
    mean = np.linalg.solve(precision, prior.mean / prior.std**2 + h.T @ problem.observations.values / 0.2**2)
    assert found.posterior.mean(axis=0) == pytest.approx(mean, abs=1e-9 if linearisation == "bundle" else 1e-10)
    assert np.cov(found.posterior.T) == pytest.approx(np.linalg.inv(precision), abs=1e-9)
    assert build_groups(found, {})["/constant_data"].attrs["tied"] == '{"c": ["a", -1.7]}'


def test_a_member_outside_of_the_bounds_of_the_tied_parameter_is_lost():
    problem = pair()
    (tie,) = problem.tied
    bounded = replace(tie, parameter=replace(tie.parameter, bounds=(-3.0, np.inf)))
    found = assimilate(replace(problem, tied=(bounded,)), AssimilationSettings(members=12, min_active_fraction=0.1), 1)
    assert set(found.prior_failures) == {"", "ValueError: c outside [-3, inf] m"}


@pytest.mark.parametrize(
    ("ties", "words"),
    [
        ((), "c: neither fixed nor estimated"),
        (("b", "a"), "b: tied, and fixed or estimated as well"),
        (("c", "d"), "d: not estimated, but others are tied to it"),
    ],
)
def test_an_incomplete_problem_is_refused(ties, words):
    problem = pair()
    (tie,) = problem.tied
    tied = (replace(tie, parameter=replace(tie.parameter, name=ties[0]), to=ties[1]),) if ties else ()
    if ties and ties[0] == "b":
        tied = (*tied, tie)
    with pytest.raises(ConfigError, match=words):
        assimilate(replace(problem, tied=tied), AssimilationSettings(members=12), 1)


class TestYaml:
    """The toy's A in m, k in N/m, c in N s/m: only a model with equal units has a pair."""

    def path(self, folder: Path, entry: str) -> Path:
        (folder / "pair.py").write_text(
            "from dataclasses import replace\n"
            "from toy_models import Oscillator\n"
            "class Pair(Oscillator):\n"
            "    defaults = {}\n"
            "    c = replace(Oscillator.parameters[2], unit='N/m', display_unit='N/m')\n"
            "    parameters = (*Oscillator.parameters[:2], c)\n"
        )
        return write_toy(folder, ("name: toy_models:Oscillator", "name: pair.py:Pair"), ("c: 0.02 N s/m", entry))

    def test_to_an_estimated_one(self, tmp_path):
        config = load_config(self.path(tmp_path, "c: {tied: k, factor: 0.01}"))
        (problem,) = build(config)
        assert [(t.parameter.name, t.to, t.factor) for t in problem.tied] == [("c", "k", 0.01)]
        assert simulate(config).theta["c"] == pytest.approx(0.03)

    def test_to_a_fixed_one(self, tmp_path):
        path = self.path(tmp_path, "c: {tied: k, factor: 0.5}")
        path.write_text(path.read_text().replace("k: {prior: lognormal, median: 3 N/m, log_std: 0.3}", "k: 4 N/m"))
        (problem,) = build(load_config(path))
        assert (problem.fixed["c"], problem.tied) == (2.0, ())

    @pytest.mark.parametrize(
        ("entry", "words"),
        [
            ("c: {tied: q}", "'q' is not another parameter of the model; known: A, k"),
            ("c: {tied: c}", "'c' is not another parameter of the model"),
            ("c: {tied: A}", "A is in m, c in N/m"),
            ("c: {tied: k, factor: two}", "should be a valid number"),
            ("c: {tied: k, factors: 2}", "unknown key 'factors'; did you mean 'factor'?"),
            ("c: 1 N/m\n  t_s: {tied: k}", "t_s is not a parameter of the model and cannot be tied"),
        ],
    )
    def test_bad_input_is_told_in_place(self, tmp_path, entry, words):
        with pytest.raises(ConfigError) as error:
            load_config(self.path(tmp_path, entry))
        (told,) = error.value.problems
        assert words in told.message
        assert told.line in (15, 16)
