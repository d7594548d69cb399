"""The laser bubble with vapour transport and a conducting medium against a separately written one (``oracle_full``)."""

from __future__ import annotations

import numpy as np
import pytest
from oracle_full import Bubble
from reference_cases import ACCURATE, LASER, NEO_HOOKEAN

from en4dvar_bubble import simulate

TIMES = np.linspace(0, 60e-6, 601)  # collapse at 23 µs, maximum of the first rebound near 30 µs, second collapse
GRIDS = {"coarse": (20, 60), "fine": (40, 120)}  # nodes in the gas, cells in the medium, of the oracle


def difference(grid, vapour, conducting):
    """Largest |ΔR|/R_max over collapse, rebound and second collapse."""
    nodes, cells = GRIDS[grid]
    slow = Bubble(**LASER, vapour=vapour, conducting=conducting, nodes=nodes, cells=cells)
    fast = simulate(
        NEO_HOOKEAN,
        LASER,
        TIMES,
        start="laser",
        vapour=vapour,
        medium_heat="conducting" if conducting else "cold",
        accuracy=ACCURATE,
    )
    R = slow.solve(TIMES)
    assert R[:400].min() < 0.2 * LASER["R_max"]  # there was a collapse to compare
    return np.abs(R - fast.R[0].values).max() / LASER["R_max"]


def test_vapour_transport_and_conducting_medium():
    assert difference("fine", "transport", conducting=True) < 2e-3


def test_conducting_medium_without_vapour():
    assert difference("fine", "none", conducting=True) < 2e-3


@pytest.mark.slow
@pytest.mark.parametrize(
    ("vapour", "conducting"),
    [("none", False), ("none", True), ("frozen", True), ("transport", False), ("transport", True)],
)
def test_difference_is_the_oracles_truncation_error(vapour, conducting):
    coarse, fine = (difference(grid, vapour, conducting) for grid in GRIDS)
    assert fine < 2e-3
    assert fine < coarse / 3
