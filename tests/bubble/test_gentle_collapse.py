"""A bubble that a stiff gel hardly lets collapse swings about its radius at rest, proposed from its minimum."""

from __future__ import annotations

import numpy as np
import pytest
import yaml

from en4dvar_bubble import simulate
from en4dvar_bubble.starter.proposal import Proposal, propose

STIFF = {"G": 100e3, "mu": 0.05, "R_max": 100e-6, "R_eq": 62e-6}
USUAL = {"G": 5e3, "mu": 0.02, "R_max": 100e-6, "R_eq": 14e-6}


def proposal(values: dict[str, float], step: float, end: float) -> Proposal:
    """Of readings with an error of 0.5 % of R_max, before the bubble rests."""
    times = np.arange(0, end, step)
    data = simulate("neo-hookean-kelvin-voigt", values, times, start="laser", gas="polytropic")
    noise = np.random.default_rng(3).normal(0, 0.5e-6, len(times))
    return propose({"bubble": (times, data.R[0].values + noise)}, "laser")


def median(of: Proposal, name: str) -> float:
    (line,) = (line for line in of.parameters if line.key == name)
    return float(yaml.safe_load(line.value)["median"].split()[0])


@pytest.mark.parametrize("step", [0.2e-6, 0.5e-6])
def test_the_radius_at_rest_lies_above_a_minimum_that_is_resolved(step):
    """0.12 R_max is four standard deviations off, and excludes the gel: G came out as a quarter of what it is."""
    stiff = proposal(STIFF, step, 25e-6)
    assert median(stiff, "R_eq") == pytest.approx(62, rel=0.15)
    assert median(stiff, "G") == pytest.approx(100, rel=1.0)  # kPa
    assert not [words for words in stiff.warnings if "will give this rebound" in words]


@pytest.mark.parametrize("step", [0.2e-6, 0.5e-6, 0.7e-6])
def test_a_collapse_between_two_frames_tells_nothing_of_it(step):
    assert median(proposal(USUAL, step, 25e-6), "R_eq") == pytest.approx(12, rel=0.05)
