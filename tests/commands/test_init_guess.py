"""The first guess of G and μ that ``en4dvar init`` makes, against the truth of bubbles simulated here."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from init_files import UNITS, call, proposed, write

from en4dvar_bubble import simulate
from en4dvar_bubble.collapse import lobe
from en4dvar_bubble.starter.guess import first_guess
from en4dvar_bubble.starter.look import second_maximum
from en4dvar_bubble.starter.proposal import built


@pytest.mark.parametrize(
    ("G", "mu", "told", "most"), [(2.5e3, 0.09, "mu", 0.6), (3e4, 0.05, "G", 0.4)], ids=["soft", "stiff"]
)
def test_the_guess_is_near_the_truth(G: float, mu: float, told: str, most: float) -> None:
    """Within twice the std of ln that it states, which is at most ``most`` where collapse and rebound tell: μ of a soft
    gel, G of a stiff one. Without this bound a guess that is off could excuse itself by a std that is as large.
    """
    model, law = built("laser", None)
    size, truth, times = {"R_max": 200e-6, "R_eq": 30e-6}, {"G": G, "mu": mu}, np.linspace(0, 80e-6, 400)
    seen = simulate(law, {**truth, **size}, times, start="laser", accuracy="reference")["R"].values.squeeze()
    guess = first_guess(model, size, {"t_c": lobe(times, seen).t_c, "rebound": second_maximum(seen)})
    for name, value in truth.items():
        assert abs(np.log(guess.values[name] / value)) < 2 * guess.log_std[name], name
    assert guess.log_std[told] < most


@pytest.mark.usefixtures("own_folder")
def test_what_relaxes_may_be_anything_that_a_collapse_shows(tmp_path: Path) -> None:
    """Between the 5 and 95 % of its prior lie 0.1 to 10 µs, and what gels have of viscosity: 0.03 to 0.19 Pa s."""
    write(tmp_path / "b.csv")
    assert call("init", "--data", tmp_path / "b.csv", *UNITS, "--law", "zener-neo-hookean").exit_code == 0
    stated = {entry.parameter.name: entry.spec for entry in proposed(Path("b.yaml")).parameters}
    for name, low, high in (("relaxation_time", 0.1e-6, 10e-6), ("mu_p", 0.03, 0.19)):
        term = stated[name]
        assert abs(np.log([low, high]) - np.log(term.median)).max() < 1.645 * term.log_std
