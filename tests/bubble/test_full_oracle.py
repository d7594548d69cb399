"""The laser bubble with vapour transport and a conducting medium against a separately written one (``oracle_full``)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from oracle_full import Bubble, Constants
from reference_cases import ACCURATE, LASER, NEO_HOOKEAN

from en4dvar_bubble import simulate
from en4dvar_bubble.medium import WATER_25C

TIMES = np.linspace(0, 60e-6, 601)  # collapse at 23 µs, maximum of the first rebound near 30 µs, second collapse
COARSE, FINE = (20, 60), (40, 120)  # nodes in the gas, cells in the medium, of the oracle


def difference(grid, vapour, conducting, accommodation=None, **diffusivity):
    """Largest |ΔR|/R_max over collapse, rebound and second collapse."""
    nodes, cells = grid
    finite = {} if accommodation is None else {"accommodation": accommodation}
    constants = Constants(**finite, **diffusivity)
    slow = Bubble(**LASER, vapour=vapour, conducting=conducting, nodes=nodes, cells=cells, constants=constants)
    fast = simulate(
        NEO_HOOKEAN,
        {**LASER, **finite},
        TIMES,
        start="laser",
        vapour=vapour,
        medium_heat="conducting" if conducting else "cold",
        accuracy=ACCURATE,
        medium=replace(WATER_25C, **diffusivity),
    )
    R = slow.solve(TIMES)
    assert R[:400].min() < 0.2 * LASER["R_max"]  # there was a collapse to compare
    return np.abs(R - fast.R[0].values).max() / LASER["R_max"]


@pytest.mark.slow
def test_vapour_transport_and_conducting_medium():
    assert difference(FINE, "transport", conducting=True) < 2e-3


@pytest.mark.slow
@pytest.mark.long
def test_diffusivity_of_kinetic_theory():
    assert difference(FINE, "transport", conducting=True, D_p=1.0, D_T=1.75) < 2e-3


@pytest.mark.slow
@pytest.mark.parametrize(("conducting", "coarse", "fine"), [(False, (48, 0), (96, 0)), (True, COARSE, FINE)])
def test_vapour_that_crosses_the_wall_at_a_finite_rate(conducting, coarse, fine):
    error = difference(fine, "transport", conducting, accommodation=0.1)
    assert error < 2e-3
    assert error < difference(coarse, "transport", conducting, accommodation=0.1) / 3


@pytest.mark.slow
def test_conducting_medium_without_vapour():
    assert difference(FINE, "none", conducting=True) < 2e-3


@pytest.mark.slow
@pytest.mark.parametrize(
    ("vapour", "conducting", "coarse", "fine"),
    [
        pytest.param("none", False, COARSE, FINE, marks=pytest.mark.long),
        pytest.param("none", True, COARSE, FINE, marks=pytest.mark.long),
        pytest.param("frozen", True, COARSE, FINE, marks=pytest.mark.long),
        # Held at T_inf the wall takes up nearly all vapour: the most violent collapse, where the oracle's ṗ needs most.
        ("transport", False, (48, 0), (96, 0)),
        pytest.param("transport", True, COARSE, FINE, marks=pytest.mark.long),
    ],
)
def test_difference_is_the_oracles_truncation_error(vapour, conducting, coarse, fine):
    error = difference(fine, vapour, conducting)
    assert error < 2e-3
    assert error < difference(coarse, vapour, conducting) / 3
