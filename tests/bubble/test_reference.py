"""Against trajectories of an independent solver, where the workshop folder ``../shared/reference`` is present."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from en4dvar_bubble import simulate

REFERENCE = Path(__file__).resolve().parents[3] / "shared" / "reference"


def reference(name):
    path = REFERENCE / name
    if not path.exists():
        pytest.skip(f"reference trajectories not present: {path}")
    return np.load(path, allow_pickle=False)


def acoustic(**options):
    z = reference("acoustic.npz")
    parameters = {"G": z["G_Pa"], "alpha": z["alpha"], "mu": z["mu_Pa_s"], "R0": z["R0_m"]}
    return z, simulate("quadratic-kelvin-voigt", parameters, z["t_s"], **options)


def first_collapse(t, R):
    """Index where R first falls below 10 µm after growth."""
    return np.flatnonzero((t > t[np.argmax(R)]) & (R < 10e-6))[0]


@pytest.mark.parametrize("case", range(4))
def test_polytropic_radius_up_to_the_first_collapse(case):
    z, data = acoustic(gas="polytropic")
    expected = z["R_polytropic_m"][case]
    before = slice(0, first_collapse(z["t_s"], expected))
    np.testing.assert_allclose(data.R[case][before], expected[before], rtol=0, atol=5e-4 * expected.max())


@pytest.mark.parametrize(("accuracy", "rms"), [("standard", 2e-5), ("reference", 1e-6)])
@pytest.mark.parametrize("case", range(4))
def test_heat_radius_before_collapse(case, accuracy, rms):
    z, data = acoustic(accuracy=accuracy)
    expected = z["R_m"][case]
    before = slice(0, first_collapse(z["t_s"], expected))
    error = np.sqrt(np.mean((data.R[case][before] - expected[before]) ** 2)) / expected.max()
    assert error < rms


@pytest.mark.parametrize("case", range(4))
def test_heat_maximum_and_instant_of_collapse(case):
    z, data = acoustic()
    t, expected, got = z["t_s"], z["R_m"][case], data.R[case].values
    assert got.max() == pytest.approx(expected.max(), rel=1e-3)

    def instant(R):  # R = 10 µm on the way down, linear in R² (the wall is nearly in free fall)
        i = first_collapse(t, R)
        return np.interp(-1e-10, -(R[i - 1 : i + 1] ** 2), t[i - 1 : i + 1])

    assert instant(got) == pytest.approx(instant(expected), abs=0.02e-6)


@pytest.mark.parametrize("case", range(4))
def test_radius_returns_to_rest(case):
    z, data = acoustic()
    assert float(data.R[case][-1]) == pytest.approx(z["R0_m"][case], rel=1e-6)
