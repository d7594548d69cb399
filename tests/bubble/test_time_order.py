"""The order of convergence in time of the compiled kernel itself, on the bubble's own equations.

Fixed steps without a special mode of the solver: no step straddles a stop of the driving, and with a huge tolerance
every step reaches the next stop; only the first interval takes a few shorter steps.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from en4dvar_bubble import Accuracy, simulate
from en4dvar_bubble.driving import Driving
from en4dvar_bubble.medium import WATER_25C
from en4dvar_bubble.solver import rodas5p

LAW, BUBBLE = "quadratic-kelvin-voigt", {"G": 2e4, "alpha": 0.05, "mu": 0.02, "R0": 5e-6}
END = 4e-6


def _pulse(t):
    return np.sin(np.pi * np.clip(t / END, 0, 1)) ** 6 * np.cos(2e6 * t)


def final(intervals, rtol, nodes, **options):
    """R at the end and the number of steps."""
    stops = tuple(END * k / intervals for k in range(1, intervals))
    driving = Driving(-3e5, 0.0, END, _pulse, 512, stops)
    data = simulate(LAW, BUBBLE, [END], driving=driving, accuracy=Accuracy(nodes, rtol), **options)
    return data.R.item(), data.steps.item()


def order(numbers=(240, 480), **options):
    """Observed between two numbers of steps."""
    exact, _ = final(100, 1e-12, **options)
    errors = []
    for intervals in numbers:
        R, steps = final(intervals, 1e6, **options)
        assert intervals <= steps <= intervals + 4
        errors.append(abs(R / exact - 1))
    assert errors[1] > 5e-12  # above rounding
    return np.log2(errors[0] / errors[1])


@pytest.mark.parametrize("reading", ["instantaneous", "retarded", "as-printed"])
@pytest.mark.parametrize(("gas", "nodes"), [("polytropic", 4), ("heat", 4), ("heat", 6)])
def test_order_of_the_method(gas, nodes, reading):
    """Of 4 nodes, with loops that the compiler unrolls, and of 6."""
    assert order(gas=gas, nodes=nodes, driving_read=reading) == pytest.approx(rodas5p.ORDER, abs=0.1)


@pytest.mark.parametrize(
    ("vapour", "medium_heat"), [("none", "conducting"), ("transport", "cold"), ("transport", "conducting")]
)
def test_order_with_every_field(vapour, medium_heat):
    """The order of a Rosenbrock method is lost with any wrong entry of the Jacobian.

    The border's entries are one-sided differences of 1e-7, right to about as much: with differences of 1e-6 the order
    of full physics is 4.90 here instead of 4.95, and between 240 and 480 steps 4.55 instead of 4.87 (4.90 with 1e-8),
    where the error of 1e-11 of R is partly theirs. Hence fewer steps than above.
    """
    medium = replace(WATER_25C, D_p=1.0, D_T=1.75)
    found = order((120, 240), nodes=5, vapour=vapour, medium_heat=medium_heat, medium=medium)
    assert found == pytest.approx(rodas5p.ORDER, abs=0.1)


def test_it_moves():
    data = simulate(LAW, BUBBLE, np.linspace(0, END, 50), driving=Driving(-3e5, 0.0, END, _pulse))
    assert float(data.R.max() / data.R.min()) > 1.3
