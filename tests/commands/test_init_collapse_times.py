"""A table with a row a bubble, R_max, R_max/R_eq and collapse time: from ``init`` to one gel for all."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from scipy.io import savemat

from en4dvar.assembly.build import build
from en4dvar.cli import main
from en4dvar.config import load_config
from en4dvar.plumbing.errors import ConfigError
from en4dvar_bubble import BubbleModel
from en4dvar_bubble.events import events
from en4dvar_bubble.laws.loading import get_law
from en4dvar_bubble.medium import Medium
from en4dvar_bubble.starter import elsewhere
from en4dvar_bubble.starter.summaries import summaries

R_MAX, STRETCH = np.linspace(150e-6, 390e-6, 7), np.array([6.0, 8.5, 5.5, 7.0, 9.0, 6.5, 8.0])
GEL = {"G": 8e3, "mu": 0.09}


def collapses(
    law: str, theta: Mapping[str, float], R_max=R_MAX, R_eq=R_MAX / STRETCH, **constants: float
) -> np.ndarray:
    """Collapse times (7,) s, as the law says, without noise."""
    model = BubbleModel(law=get_law(law), start="laser", gas="polytropic", medium=replace(Medium(), **constants))
    members = {name: np.full(len(R_max), value) for name, value in theta.items()}
    start = model.initial_states({**members, "R_max": R_max, "R_eq": R_eq})
    return events(model.integrate(start, np.tile([6e-5], (len(R_max), 1))))["time"][:, 1]


def rows_of(law: str, theta: dict[str, float]) -> np.ndarray:
    """(7, 3) of such bubbles."""
    return np.column_stack([R_MAX, STRETCH, collapses(law, theta)])


@pytest.fixture(scope="module")
def rows():
    return rows_of("neo-hookean-kelvin-voigt", GEL)


def typed(*words):
    return CliRunner().invoke(main, list(map(str, words)), catch_exceptions=False)


@pytest.fixture
def begun(rows, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    savemat("pool.mat", {"pool": rows})
    return typed("init", "--data", "pool.mat")


def test_init_writes_a_row_a_bubble_and_what_to_type_next(begun, rows):
    assert begun.exit_code == 0
    assert "7 rows of R_max, R_max/R_eq and collapse time" in begun.output
    assert "next: en4dvar validate pool.yaml" in begun.output
    with open("pool_bubbles.csv", encoding="utf-8") as file:
        table = list(csv.DictReader(file))
    held = np.array([[float(row[key]) for key in ("R_max_um", "R_eq_um", "collapse_us")] for row in table])
    np.testing.assert_allclose(
        held, 1e6 * np.column_stack([rows[:, 0], rows[:, 0] / rows[:, 1], rows[:, 2]]), rtol=1e-8
    )


def test_each_bubble_has_its_own_radii_and_all_have_one_gel(begun, rows):
    config = load_config("pool.yaml")
    problems = build(config)
    assert len(problems) == len(rows)
    for problem, (R_max, stretch, t_c) in zip(problems, rows, strict=True):
        terms = {term.parameter.name: term for term in problem.prior.terms}
        assert math.exp(terms["R_max"].mean) == pytest.approx(R_max, rel=1e-8)
        assert math.exp(terms["R_eq"].mean) == pytest.approx(R_max / stretch, rel=1e-8)
        assert problem.observations.values == pytest.approx([t_c], rel=1e-8)
    shared = {entry.parameter.name for entry in config.parameters if entry.spec.shared}
    assert shared == {"G", "mu", "rho", "c", "p_inf", "reading_scale"}


def test_what_is_known_from_elsewhere_is_estimated_as_from_radii(rows, begun):
    """The constants have the priors of a medium, as a configuration of radii does; a named one has its own."""
    held = {entry.parameter.name: entry.spec for entry in load_config("pool.yaml").parameters}
    for known in elsewhere.known("gel"):
        assert held[known.key].log_std == known.log_std
    assert typed("init", "--data", "pool.mat", "--medium", "agarose", "--out", "agarose.yaml").exit_code == 0
    agarose = {entry.parameter.name: entry.spec for entry in load_config("agarose.yaml").parameters}
    assert agarose["rho"].log_std < 0.5 * held["rho"].log_std


def test_every_number_of_another_law_is_shared(rows, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    savemat("pool.mat", {"pool": rows})
    assert typed("init", "--data", "pool.mat", "--law", "zener-neo-hookean").exit_code == 0
    config = load_config("pool.yaml")
    own = {entry.parameter.name for entry in config.parameters if not entry.spec.shared}
    assert own == {"R_max", "R_eq"}


def test_a_scalar_that_a_prior_lacks_is_named_with_its_line(begun):
    text = Path("pool.yaml").read_text(encoding="utf-8")
    Path("pool.yaml").write_text(text.replace("from_file: R_eq_um", "from_file: R_eq"), encoding="utf-8")
    with pytest.raises(ConfigError, match=r"pool\.yaml:\d+:.*no scalar 'R_eq' for R_eq; did you mean 'R_eq_um'"):
        build(load_config("pool.yaml"))


def test_a_row_a_bubble_has_no_readings_to_leave_out(begun):
    refused = typed("init", "--data", "pool.mat", "--since", "trough 1", "--force")
    assert refused.exit_code == 2
    assert "no readings that --since could leave out" in refused.output


def test_a_table_that_is_there_is_not_replaced(begun):
    Path("pool.yaml").unlink()
    again = typed("init", "--data", "pool.mat")
    assert again.exit_code != 0
    assert "pool_bubbles.csv: exists; give --force" in again.output
    assert typed("init", "--data", "pool.mat", "--force").exit_code == 0


def test_what_may_be_something_else_is_not_taken_for_it(rows):
    a, b, c = rows.T
    assert summaries({"a": a, "b": b, "c": c}) is not None
    assert summaries({"a": a * 1e6, "b": b, "c": c}) is None  # in µm: the unit would be a guess
    assert summaries({"a": a, "b": b, "c": 10 * c}) is None
    assert summaries({"a": a[:1], "b": b[:1], "c": c[:1]}) is None


SIMULATED = {  # the rows have no errors, and were made with these constants
    "data.error.collapse_time_std": "5 ns",
    "parameters.R_max.log_std": "1e-4",
    "parameters.R_eq.log_std": "1e-4",
    "parameters.rho": "998 kg/m^3",
    "parameters.c": "1484 m/s",
    "parameters.p_inf": "101325 Pa",
    "parameters.reading_scale": "1",
}


def estimated(law: str, rows: np.ndarray, known: Mapping[str, str]) -> tuple[dict[str, dict[str, float]], str]:
    """What is shared, by name: mean, std and quantiles in display units; and what the terminal said."""
    savemat("pool.mat", {"pool": rows})
    begun = typed("init", "--data", "pool.mat", "--medium", "water", "--law", law, "--out", f"{law}.yaml", "--force")
    assert begun.exit_code == 0
    quicker = {"model.gas": "polytropic", "model.vapour": "none"}
    words = [word for key, value in {**known, **quicker}.items() for word in ("--set", f"{key}={value}")]
    done = typed("run", f"{law}.yaml", *words, "--force")
    assert done.exit_code == 0, done.output
    with open(f"runs/{law}/joint.csv", encoding="utf-8") as file:
        cells = {row.pop("name"): row for row in csv.DictReader(file)}
    numbers = ("mean", "std", "q05", "q95")
    return {name: {key: float(row[key]) for key in numbers if row.get(key)} for name, row in cells.items()}, done.output


@pytest.mark.slow
def test_the_gel_comes_back_and_another_law_misfits(rows, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    found, said = estimated("neo-hookean-kelvin-voigt", rows, SIMULATED)
    assert "χ² per reading" not in said
    for name, scale in (("G", 1e-3), ("mu", 1.0)):
        assert found[name]["std"] < 0.05 * found[name]["mean"]
        assert abs(found[name]["mean"] - GEL[name] * scale) < 4 * found[name]["std"]
    other = rows_of("zener-neo-hookean", {"G": 8e3, "mu_p": 0.3, "relaxation_time": 3e-6})
    _, said = estimated("neo-hookean-kelvin-voigt", other, SIMULATED)
    assert "χ² per reading" in said
    found, said = estimated("zener-neo-hookean", other, SIMULATED)
    assert "χ² per reading" not in said
    assert found["G"]["q05"] < 8 < found["G"]["q95"]


@pytest.mark.slow
def test_the_interval_knows_that_constants_and_camera_err_alike_for_all_bubbles(rows, tmp_path, monkeypatch):
    """Against the linear theory of ln G, ln μ and of what is known from elsewhere, by differences of collapse times."""
    monkeypatch.chdir(tmp_path)
    exact = {key: SIMULATED[key] for key in list(SIMULATED)[:3]}
    found, _ = estimated("neo-hookean-kelvin-voigt", rows, exact)
    law, h, t = "neo-hookean-kelvin-voigt", 1e-3, rows[:, 2]
    slopes = [collapses(law, {**GEL, name: GEL[name] * math.exp(h)}) for name in GEL]
    known = {quantity.key: quantity for quantity in elsewhere.known("water")}
    slopes += [collapses(law, GEL, **{k: getattr(Medium(), k) * math.exp(h)}) for k in known if k != "reading_scale"]
    J = np.column_stack([*((moved - t) / h for moved in slopes), t])
    radii = [collapses(law, GEL, R_MAX * math.exp(h)), collapses(law, GEL, R_eq=R_MAX / STRETCH * math.exp(h))]
    variance = 5e-9**2 + sum((1e-4 * (moved - t) / h) ** 2 for moved in radii)
    prior = np.array([1.5, 1.2, *(quantity.log_std for quantity in known.values())])
    posterior = np.linalg.inv(np.diag(prior**-2.0) + J.T @ (J / variance[:, None]))
    alone = np.linalg.inv(np.diag(prior[:2] ** -2.0) + J[:, :2].T @ (J[:, :2] / variance[:, None]))
    for i, (name, scale) in enumerate((("G", 1e-3), ("mu", 1.0))):
        truth, std = GEL[name] * scale, GEL[name] * scale * math.sqrt(posterior[i, i])
        assert found[name]["q05"] < truth < found[name]["q95"]
        assert found[name]["std"] == pytest.approx(std, rel=0.25)
    assert posterior[0, 0] > 9 * alone[0, 0]  # it is these errors that the interval is made of
