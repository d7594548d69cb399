"""The order of convergence in time of the compiled kernel itself, on the bubble's own equations.

Fixed steps without a special mode of the solver: no step straddles a stop of the driving, and with a huge tolerance
every step reaches the next stop; only the first interval takes a few shorter steps.
"""

from __future__ import annotations

import numpy as np
import pytest

from en4dvar_bubble import Accuracy, simulate
from en4dvar_bubble.driving import Driving
from en4dvar_bubble.solver import rodas5p

LAW, BUBBLE = "quadratic-kelvin-voigt", {"G": 2e4, "alpha": 0.05, "mu": 0.02, "R0": 5e-6}
END = 4e-6


def _pulse(t):
    return np.sin(np.pi * np.clip(t / END, 0, 1)) ** 6 * np.cos(2e6 * t)


def final(intervals, rtol, **options):
    """R at the end and the number of steps."""
    stops = tuple(END * k / intervals for k in range(1, intervals))
    driving = Driving(-3e5, 0.0, END, _pulse, 512, stops)
    data = simulate(LAW, BUBBLE, [END], driving=driving, accuracy=Accuracy(nodes=6, rtol=rtol), **options)
    return data.R.item(), data.steps.item()


@pytest.mark.parametrize("reading", ["instantaneous", "retarded", "as-printed"])
@pytest.mark.parametrize("gas", ["heat", "polytropic"])
def test_order_of_the_method(gas, reading):
    exact, _ = final(100, 1e-12, gas=gas, driving_read=reading)
    errors = []
    for intervals in (240, 480):
        R, steps = final(intervals, 1e6, gas=gas, driving_read=reading)
        assert intervals <= steps <= intervals + 4
        errors.append(abs(R / exact - 1))
    order = np.log2(errors[0] / errors[1])
    assert errors[1] > 5e-12  # above rounding
    assert order == pytest.approx(rodas5p.ORDER, abs=0.1)


def test_it_moves():
    data = simulate(LAW, BUBBLE, np.linspace(0, END, 50), driving=Driving(-3e5, 0.0, END, _pulse))
    assert float(data.R.max() / data.R.min()) > 1.3
