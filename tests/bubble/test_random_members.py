"""Members drawn far and wide: none crashes or hangs, hardly any fails, and each failure has a reason."""

from __future__ import annotations

import numpy as np
import pytest

from en4dvar_bubble import simulate

CENTRE = {"G": 2e3, "mu": 0.1, "R0": 1e-6}  # of the paper's estimates, geometric
TIMES = np.linspace(4e-6, 80e-6, 39)
REASONS = ("step limit reached", "non-finite state", "step size underflow", "model validity", "time limit")


def wide(n, seed=0):
    """G, μ, R0 within a factor of ten either way, α up to one, all log-uniform."""
    rng = np.random.default_rng(seed)
    members = {name: value * 10 ** rng.uniform(-1, 1, n) for name, value in CENTRE.items()}
    return members | {"alpha": 10 ** rng.uniform(-4, 0, n)}


def check(data, n, fraction):
    failed = data.status.values != 0
    assert failed.mean() < fraction
    assert all(reason.startswith(REASONS) for reason in data.reason.values[failed])
    assert all(reason == "" for reason in data.reason.values[~failed])
    R = data.R.values
    assert R.shape == (n, len(data.time))
    assert np.isnan(R[failed]).all()
    assert np.isfinite(R[~failed]).all()
    assert (R[~failed] > 0).all()
    assert np.isfinite(data.p_b.values[~failed]).all()


@pytest.mark.slow
@pytest.mark.parametrize("gas", ["heat", "polytropic"])
def test_twenty_thousand_wide_acoustic_members(gas):
    n = 20_000
    data = simulate("quadratic-kelvin-voigt", wide(n), TIMES, gas=gas, workers=2)
    check(data, n, 1e-3)
    assert float(data.R.max()) > 2e-4  # the wide prior reaches violent members
    assert float(data.max_wall_mach.max()) > 10


@pytest.mark.slow
def test_wide_laser_members():
    n = 4_000
    members = wide(n)
    R_max = 2e-4 * 10 ** np.random.default_rng(1).uniform(-0.5, 0.5, n)
    ratio = np.random.default_rng(2).uniform(2, 12, n)
    members |= {"R_max": R_max, "R_eq": R_max / ratio}
    del members["R0"]
    check(simulate("quadratic-kelvin-voigt", members, TIMES, start="laser", workers=2), n, 1e-3)


@pytest.mark.parametrize("reading", ["instantaneous", "retarded", "as-printed"])
def test_wide_members_of_every_reading(reading):
    check(simulate("quadratic-kelvin-voigt", wide(400), TIMES, driving_read=reading), 400, 1e-3)
