"""A table with a row a bubble, R_max, R_max/R_eq and collapse time: from ``init`` to one gel for all."""

from __future__ import annotations

import csv
import math
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
from en4dvar_bubble.starter import elsewhere
from en4dvar_bubble.starter.summaries import summaries

R_MAX, STRETCH = np.linspace(150e-6, 390e-6, 7), np.array([6.0, 8.5, 5.5, 7.0, 9.0, 6.5, 8.0])
GEL = {"G": 8e3, "mu": 0.09}


def rows_of(law: str, theta: dict[str, float]) -> np.ndarray:
    """(7, 3) of bubbles that collapse as the law says, without noise."""
    model = BubbleModel(law=get_law(law), start="laser", gas="polytropic")
    members = {name: np.full(len(R_MAX), value) for name, value in theta.items()}
    paths = model.integrate(
        model.initial_states({**members, "R_max": R_MAX, "R_eq": R_MAX / STRETCH}), np.tile([6e-5], (len(R_MAX), 1))
    )
    return np.column_stack([R_MAX, STRETCH, events(paths)["time"][:, 1]])


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


def estimated(law: str, rows: np.ndarray) -> tuple[dict[str, tuple[float, float]], str]:
    """Mean and std of what is shared, SI, and what the terminal said; with errors as small as these rows have."""
    savemat("pool.mat", {"pool": rows})
    assert typed("init", "--data", "pool.mat", "--law", law, "--out", f"{law}.yaml", "--force").exit_code == 0
    known = ["data.error.collapse_time_std=5 ns", "parameters.R_max.log_std=1e-4", "parameters.R_eq.log_std=1e-4"]
    quicker = ["model.gas=polytropic", "model.vapour=none"]
    words = [word for text in (*known, *quicker) for word in ("--set", text)]
    done = typed("run", f"{law}.yaml", *words, "--force")
    assert done.exit_code == 0, done.output
    with open(f"runs/{law}/joint.csv", encoding="utf-8") as file:
        table = {row["name"]: row for row in csv.DictReader(file) if row["name"] in ("G", "mu")}
    return table, done.output


@pytest.mark.slow
def test_the_gel_comes_back_and_another_law_misfits(rows, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    table, said = estimated("neo-hookean-kelvin-voigt", rows)
    assert "[misfit]" not in said
    for name, scale in (("G", 1e-3), ("mu", 1.0)):
        mean, std = float(table[name]["mean"]), float(table[name]["std"])
        assert std < 0.05 * mean
        assert abs(mean - GEL[name] * scale) < 4 * std
    other = rows_of("zener-neo-hookean", {"G": 8e3, "mu_p": 0.3, "relaxation_time": 3e-6})
    _, said = estimated("neo-hookean-kelvin-voigt", other)
    assert "misfit" in said
    _, said = estimated("zener-neo-hookean", other)
    assert "misfit" not in said
