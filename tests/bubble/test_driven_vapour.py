"""Vapour transport in a bubble that is driven from rest and grows a hundredfold: it becomes nearly all vapour."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from en4dvar_bubble import Accuracy, BubbleModel
from en4dvar_bubble.medium import WATER_25C, saturated_vapour_pressure

KINETIC = replace(WATER_25C, D_p=1.0, D_T=1.75)
THETA = {"G": 6900.0, "alpha": 0.025, "mu": 0.15, "R0": 1.3e-6}
TIMES = np.linspace(1e-7, 60e-6, 600)


def path(times=TIMES, **options):
    model = BubbleModel(vapour="transport", medium=KINETIC, **options)
    return model.trajectories(model.initial_state(THETA)[None], times)[0]


@pytest.fixture(scope="module")
def driven():
    return path(accuracy=Accuracy(nodes=8))


def test_growth_is_at_the_saturated_vapour_pressure(driven):
    R, saturated = driven["R"], saturated_vapour_pressure(KINETIC.T_inf)
    large = R / R.max() > 0.5
    gas = 1 - KINETIC.mole_fraction(driven["C"])
    assert gas.min() > 0
    assert gas[large].max() < 1e-2  # nearly all vapour
    excess = driven["p_b"][large] / saturated - 1
    assert np.all(excess > 0)
    assert excess.max() < 0.05


def test_same_on_twice_the_grid(driven):
    fine = path(accuracy=Accuracy(nodes=16))
    before = TIMES < 21e-6  # the collapse comes at 22.1 µs
    np.testing.assert_allclose(driven["R"][before], fine["R"][before], rtol=0, atol=2e-5 * fine["R"].max())


def test_comes_to_rest_at_its_first_radius(driven):
    """The vapour has condensed to what was there, and no gas was lost."""
    assert driven["R"][-1] == pytest.approx(THETA["R0"], rel=1e-6)
    start = KINETIC.mole_fraction(driven["C"][0])
    np.testing.assert_allclose(KINETIC.mole_fraction(driven["C"][-1]), start, rtol=1e-4)


def test_constant_diffusivity_is_refused():
    with pytest.raises(ValueError, match=r"needs D_p, e\.g\. constants: \{D_p: 1, D_T: 1\.75\}"):
        BubbleModel(vapour="transport")


def test_a_wall_beyond_the_critical_point_is_named():
    """A conducting wall heats to 970 K in this collapse; no vapour pressure goes with that."""
    failure = path(np.array([60e-6]), medium_heat="conducting", accuracy=Accuracy(nodes=8))
    assert failure.reason.startswith("model validity: wall above the critical temperature of water at t = 22.")
