"""``en4dvar init`` of a coated bubble in water: what belongs to the water is not estimated, and no gel is spoken of."""

import re
from pathlib import Path

import numpy as np
import pytest
from init_files import UNITS, call

from en4dvar.assembly.build import build
from en4dvar.config import load_config
from en4dvar.problem import common_to
from en4dvar_bubble.laws.tabulate import GRID, ends
from en4dvar_bubble.solver.driver import preset

pytestmark = pytest.mark.usefixtures("own_folder")
ASKED = ("--medium", "water", "--start", "acoustic")


def _films(count: int) -> None:
    """Bubbles of 1.8 um that swing by 8 % in a burst."""
    Path("sh").mkdir()
    t = np.arange(0, 4.6, 0.04)
    for n in range(count):
        burst = np.where(t > 0.5, np.sin(2 * np.pi * 1.8 * (t - 0.5)) * np.sin(np.pi * (t - 0.5) / 4.2), 0.0)
        radii = 1.8 * (1 + n / 20) * (1 + 0.08 * burst) + np.random.default_rng(n).normal(0, 0.01, t.size)
        rows = [f"{time:.3f},{radius:.4f}\n" for time, radius in zip(t, radii, strict=True)]
        Path(f"sh/s{n}.csv").write_text("".join(["t_us,R_um\n", *rows]))


@pytest.mark.parametrize("law", ["marmottant-shell", "gompertz-shell", "sarkar-shell", "church-shell"])
def test_a_coated_bubble_in_water(law: str) -> None:
    _films(1)
    done = call("init", "--data", "sh/s0.csv", *UNITS, "--law", law, *ASKED)
    assert done.exit_code == 0, done.output
    assert "are the units of both columns right?" not in done.stderr
    assert "make G wrong" not in done.stderr
    assert "will give this" not in done.stderr
    (problem,) = build(load_config("s0.yaml"))
    driving = problem.model.driving  # type: ignore[attr-defined]
    assert 50e3 < driving.amplitude < 1e6  # as of a scanner, no pulse that tears tissue
    assert driving.end > 3e-6
    clock = problem.prior.std[problem.prior.names.index("t_s")]
    assert clock < 0.25 * driving.end / 8  # of eight cycles: shifts by one, each of which may fit, are not among it
    assert problem.fixed["mu"] == pytest.approx(0.89e-3, rel=0.02)  # IAPWS 2008, 25 °C
    buckles = law in ("marmottant-shell", "gompertz-shell")
    assert problem.model.accuracy.rtol == (1e-8 if buckles else preset("standard", "acoustic").rtol)  # type: ignore[attr-defined]
    if "marmottant" in law:
        draws = np.random.default_rng(0).standard_normal((2000, len(problem.prior.names)))
        values = problem.prior.to_physical(problem.prior.mean + problem.prior.std * draws)
        assert values[:, problem.prior.names.index("sigma_0")].max() < problem.fixed["sigma_w"]


def test_what_is_known_of_the_water_does_not_vary_from_bubble_to_bubble() -> None:
    _films(4)
    done = call("init", "--data", "sh", *UNITS, "--law", "marmottant-shell", *ASKED)
    assert done.exit_code == 0, done.output
    assert "  of: [chi, kappa_s, sigma_0] #" in Path("sh.yaml").read_text()
    assert call("validate", "sh.yaml").exit_code == 0


def test_the_error_of_the_hydrophone_is_one_for_all_bubbles() -> None:
    _films(3)
    assert call("init", "--data", "sh", *UNITS, "--law", "marmottant-shell", *ASKED).exit_code == 0
    text = Path("sh.yaml").read_text().replace("# p_A:", "p_A:")
    for written, one in ((text, True), (re.sub(r"(p_A: .*)}", r"\1, shared: none}", text), False)):
        Path("sh.yaml").write_text(written)
        problems = build(load_config("sh.yaml"))
        assert ("p_A" in common_to(problems, ["chi"])) == one
        assert "rho" in common_to(problems, ["chi"])


def test_a_law_without_any_value_says_so() -> None:
    (words,) = ends(np.full((1, GRID.cells, 8), np.nan))
    assert words.startswith(": the law has no value at any stretch with these parameters")
