"""``en4dvar init`` of bubbles so large that vapour leaves a layer at the wall thinner than the solver's grid."""

from __future__ import annotations

from pathlib import Path

import pytest
from init_files import call, proposed, rebounding

from en4dvar.assembly.build import build
from en4dvar_bubble import BubbleModel

pytestmark = pytest.mark.usefixtures("own_folder")


@pytest.mark.parametrize(
    ("largest", "vapour", "nodes"), [(0.4, "transport", 12), (1.2, "transport", 16), (12.0, "none", 12)]
)
def test_the_gas_is_one_that_the_grid_holds(largest: float, vapour: str, nodes: int) -> None:
    t, R = rebounding(0.03)
    rows = (f"{at:.6g},{radius:.6g}" for at, radius in zip(largest * 0.0992 * t, largest * R, strict=True))
    Path("spark.csv").write_text("\n".join(["t_ms,R_mm", *rows, ""]))
    done = call("init", "--data", "spark.csv", "--medium", "water", "--law", "newtonian")
    assert done.exit_code == 0, done.output
    (problem,) = build(proposed(Path("spark.yaml")))
    model = problem.model
    assert isinstance(model, BubbleModel)
    assert (model.vapour, model.system.gas) == (vapour, nodes)
    if vapour == "none":
        assert model.medium.p_v == pytest.approx(3.14e3, rel=0.02)  # Pa, of water at 25 °C
        assert "no grid holds" in Path("spark.yaml").read_text(encoding="utf-8")
