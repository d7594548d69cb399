"""Driving pressures: their shapes, their tables, what they do to a bubble."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from en4dvar.plumbing.errors import DataError
from en4dvar_bubble import Accuracy, Medium, simulate
from en4dvar_bubble.driving import from_file, gaussian, histotripsy, pulses, silence, sine_burst, step, tabulated

PULSES = {
    "histotripsy": histotripsy(),
    "sine": sine_burst(1e6, 1e6, cycles=3),
    "half a cycle": sine_burst(-2e6, 0.5e6, cycles=0.5, delay=1e-6),
    "hann": sine_burst(1e6, 1e6, cycles=4.3, delay=2e-6, phase=0.4, envelope="hann"),
    "tukey": sine_burst(1e6, 1e6, cycles=5, phase=1.0, envelope="tukey", taper=0.3),
    "gaussian": gaussian(-2e6, delay=5e-6, width=0.3e-6),
    "step": step(-1e5, duration=100e-6, delay=1e-6),
}
LAW, BUBBLE = "neo-hookean-kelvin-voigt", {"G": 2e3, "mu": 0.02, "R0": 20e-6}


def evaluate(driving, t):
    """The compiled kernel's polynomial, in plain NumPy."""
    position = (t * 1e6 - driving.grid.origin) / driving.grid.step
    cell = np.clip(np.floor(position).astype(int), 0, driving.cells - 1)
    return driving.amplitude * sum(driving.table[cell, k] * (position - cell) ** k for k in range(6))


def test_every_kind_of_the_configuration_has_an_example_here():
    assert set(pulses.PULSES) - {"none"} <= set(PULSES), "add it to PULSES above, under its name in YAML"


@pytest.mark.parametrize("name", PULSES)
class TestTable:
    def test_reproduces_the_shape(self, name):
        driving = PULSES[name]
        t = np.random.default_rng(0).uniform(driving.begin, driving.end, 20_000)
        np.testing.assert_allclose(
            evaluate(driving, t), driving.pressure(t), rtol=0, atol=1e-11 * abs(driving.amplitude)
        )

    def test_zero_outside_the_span(self, name):
        driving = PULSES[name]
        outside = np.array([driving.begin - 1e-9, driving.end + 1e-9])
        np.testing.assert_array_equal(driving.pressure(outside), 0.0)

    def test_time_steps_end_at_both_ends_and_between(self, name):
        driving = PULSES[name]
        breaks = driving.breaks
        assert np.all(np.diff(breaks) > 0)
        np.testing.assert_allclose(breaks[[0, -1]], [driving.begin * 1e6, driving.end * 1e6], rtol=1e-12)


class TestShapes:
    def test_sine_burst_is_a_sine(self):
        t = np.array([0.25e-6, 0.5e-6, 1.75e-6])
        np.testing.assert_allclose(PULSES["sine"].pressure(t), [1e6, 0.0, -1e6], atol=1e-6)

    def test_envelopes_are_scipys_windows(self):
        from scipy.signal.windows import hann, tukey

        t = np.linspace(0, 5e-6, 1001)
        wave = np.sin(2 * np.pi * 1e6 * t)
        for driving, window in (
            (sine_burst(1.0, 1e6, 5, envelope="hann"), hann(1001)),
            (sine_burst(1.0, 1e6, 5, envelope="tukey", taper=0.3), tukey(1001, 0.3)),
        ):
            np.testing.assert_allclose(driving.pressure(t), wave * window, atol=1e-12)

    def test_a_half_cycle_of_either_kind(self):
        """(1 + cos)/2 is a Hann window: the histotripsy pulse with n = 1."""
        t = np.linspace(4.5e-6, 5.5e-6, 101)
        hann = sine_burst(-24e6, 1e-3, cycles=1e-9, delay=4.5e-6, phase=np.pi / 2, envelope="hann")
        np.testing.assert_allclose(histotripsy(exponent=1.0).pressure(t), hann.pressure(t), rtol=1e-9, atol=1e-3)

    def test_gaussian_has_its_width(self):
        assert PULSES["gaussian"].pressure(5.3e-6) == pytest.approx(-2e6 * np.exp(-0.5))

    def test_step_rises_and_lasts(self):
        t = np.array([1e-6, 1.01e-6, 1.02e-6, 50e-6, 100.98e-6, 101e-6])
        np.testing.assert_allclose(PULSES["step"].pressure(t), [0, -0.5e5, -1e5, -1e5, -1e5, 0], atol=1.0)

    def test_silence(self):
        assert silence().breaks.size == 0
        assert silence().pressure(0.5e-6) == 0.0

    @pytest.mark.parametrize("options", [{"phase": 0.1}, {"cycles": 2.7}])
    def test_a_jump_is_refused(self, options):
        with pytest.raises(ValueError, match=r"jumps at its (beginning|end) by 0\."):
            sine_burst(**{"amplitude": 1e6, "frequency": 1e6, "cycles": 2, **options})

    def test_a_step_needs_time_to_rise(self):
        with pytest.raises(ValueError, match="between 3 and 200 000 times the rise"):
            step(1e5, duration=1e-6, rise=0.5e-6)


class TestTabulated:
    @pytest.mark.slow
    def test_samples_of_a_known_pulse_drive_as_the_pulse(self):
        exact = gaussian(-5e4, delay=5e-6, width=0.5e-6)
        t = np.linspace(0, 12e-6, 601)
        times = np.linspace(4e-6, 30e-6, 27)
        options = {"gas": "polytropic", "accuracy": "reference"}
        expected = simulate(LAW, BUBBLE, times, driving=exact, **options).R.values
        got = simulate(LAW, BUBBLE, times, driving=tabulated(t, exact.pressure(t)), **options).R.values
        assert np.ptp(expected) > 1e-7
        np.testing.assert_allclose(got, expected, rtol=1e-7)

    def test_interpolation_error_falls_with_the_fourth_power(self):
        def error(n, uneven):
            t = np.linspace(0, 3e-6, n)
            t = t + uneven * 0.2 * t[1] * np.sin(np.arange(n))
            q = np.random.default_rng(0).uniform(0.6e-6, 2.4e-6, 5000)
            wave = np.sin(2 * np.pi * 1e6 * q)
            return np.abs(evaluate(tabulated(t, np.sin(2 * np.pi * 1e6 * t)), q) - wave).max()

        for uneven in (0, 1):
            assert np.log2(error(121, uneven) / error(241, uneven)) == pytest.approx(4, abs=0.2)
            assert error(241, uneven) < 1e-5

    def test_passes_through_the_samples_and_leads_to_zero_within_one_interval(self):
        t = np.arange(5) * 1e-7
        p = np.array([2e5, 1e5, -3e5, 4e5, -1e5])
        driving = tabulated(t, p, delay=1e-6, scale=2.0)
        np.testing.assert_allclose(driving.pressure(t + 1e-6), 2 * p, rtol=1e-9)
        assert driving.begin == pytest.approx(0.9e-6)
        assert driving.end == pytest.approx(1.5e-6)
        np.testing.assert_allclose(driving.pressure(np.array([driving.begin, driving.end])), 0.0, atol=1e-6)
        edges = np.array([1e-6, 1.4e-6])
        slope = (driving.pressure(edges + 1e-13) - driving.pressure(edges - 1e-13)) / 2e-13
        spline = driving.shape.numbers[0]
        np.testing.assert_allclose(slope, [2 * spline(e, 1) * 4e5 for e in edges], rtol=1e-3)

    def test_from_a_csv_file_with_units(self, tmp_path):
        path = tmp_path / "hydrophone.csv"
        path.write_text("t,p,noise\n0,0,1\n0.1,-0.2,1\n0.2,-1.5,1\n0.3,-0.1,1\n0.4,0,1\n", encoding="utf-8")
        driving = from_file(path, ("t", "us"), ("p", "MPa"))
        assert driving.pressure(0.2e-6) == pytest.approx(-1.5e6)
        with pytest.raises(DataError, match="no column 'pressure'; the columns are: t, p, noise"):
            from_file(path, ("t", "us"), ("pressure", "MPa"))

    @pytest.mark.parametrize(
        ("times", "pressure", "message"),
        [
            ([0, 1, 2], [1, 2, 3], "at least four samples"),
            ([0, 1, 1, 2], [1, 2, 3, 4], "increasing times"),
            ([0, 1, 2, 3], [1, np.nan, 3, 4], "finite pressures"),
            ([0, 1, 2, 3], [0, 0, 0, 0], "zero throughout"),
            ([0, 1, 1 + 1e-9, 3], [1, 2, 3, 4], "resample the record evenly"),
        ],
    )
    def test_mistakes_are_named(self, times, pressure, message):
        with pytest.raises(ValueError, match=message):
            tabulated(np.array(times) * 1e-6, np.array(pressure))


class TestResponse:
    """A small polytropic bubble against scipy on the same equation, written here in SI units."""

    @pytest.mark.parametrize(
        "name", [pytest.param(name, marks=[pytest.mark.slow] * (name == "histotripsy")) for name in PULSES]
    )
    def test_agrees_with_an_independent_integration(self, name):
        driving = PULSES[name]
        weak = type(driving)(
            0.02 * driving.amplitude, driving.begin, driving.end, driving.shape, driving.cells, driving.stops
        )
        medium = Medium()
        times = np.linspace(0.5e-6, 30e-6, 60)
        got = simulate(LAW, BUBBLE, times, gas="polytropic", driving=weak, accuracy="reference").R[0]
        expected = integrate(weak, medium, times, **BUBBLE)
        assert np.ptp(expected) > 1e-3 * BUBBLE["R0"]
        np.testing.assert_allclose(got, expected, rtol=2e-7)

    def test_a_lasting_step_ends_at_the_new_equilibrium(self):
        """Polytropic gas, no elasticity: p_g (R0/R)^{3κ} = p_∞ + Δp + 2S/R."""
        medium, R0, rise = Medium(), 5e-6, 5e4
        R = simulate(
            LAW, {"G": 0.0, "mu": 0.05, "R0": R0}, [150e-6], gas="polytropic",
            driving=step(rise, duration=400e-6), accuracy="reference",
        ).R.item()  # fmt: skip
        gas = (medium.p_inf + 2 * medium.S / R0) * (R0 / R) ** (3 * medium.kappa)
        assert gas == pytest.approx(medium.p_inf + rise + 2 * medium.S / R, rel=1e-8)

    def test_a_sudden_step_kicks_the_wall_by_its_acoustic_velocity(self):
        """Δp/(ρc) as the rise becomes short (Keller & Miksis: (R/c) dp_f/dt)."""
        medium = Medium()
        kick = simulate(
            LAW, {"G": 0.0, "mu": 1e-6, "R0": 1e-3}, [1e-6 + 1e-10], gas="polytropic",
            driving=step(-1e4, duration=2e-5, delay=1e-6, rise=1e-10), accuracy="reference",
        ).Rdot.item()  # fmt: skip
        assert kick == pytest.approx(1e4 / (medium.rho * medium.c), rel=1e-3)

    def test_a_late_pulse_is_not_stepped_over(self):
        t = np.linspace(0, 500e-6, 10_001)
        late = tabulated(t, -2e5 * np.exp(-0.5 * ((t - 400e-6) / 0.1e-6) ** 2))
        loose = Accuracy(nodes=4, rtol=1e-3)
        R = simulate(LAW, BUBBLE, [399e-6, 402e-6], driving=late, gas="polytropic", accuracy=loose).R[0].values
        assert R[0] == pytest.approx(20e-6, rel=1e-6)
        assert abs(R[1] / 20e-6 - 1) > 1e-3


def integrate(driving, medium, times, G, mu, R0):
    """R (K,) of the polytropic neo-Hookean Keller–Miksis bubble by scipy, piece by piece between the breaks."""
    p0 = medium.p_inf + 2 * medium.S / R0
    tiny = 1e-13

    def rhs(t, y, low, high):
        R, V = y
        s = R0 / R
        at = np.clip(np.array([t - tiny, t, t + tiny]), low, high)
        f = driving.pressure(at) if high > driving.begin and low < driving.end else np.zeros(3)
        slope = (f[2] - f[0]) / (at[2] - at[0])
        gas = p0 * s ** (3 * medium.kappa)
        J = -G / 2 * (5 - 4 * s - s**4)
        dJ = -G / 2 * (4 * s + 4 * s**4) / R
        P = gas - medium.p_inf - f[1] - 2 * medium.S / R + J - 4 * mu * V / R
        dP = (-3 * medium.kappa * gas / R + 2 * medium.S / R**2 + dJ + 4 * mu * V / R**2) * V - slope
        right = ((1 + V / medium.c) * P + R / medium.c * dP) / medium.rho - 1.5 * (1 - V / (3 * medium.c)) * V**2
        return [V, right / ((1 - V / medium.c) * R + 4 * mu / (medium.rho * medium.c))]

    edges = [0.0, *(b for b in driving.breaks * 1e-6 if 0 < b < times[-1]), times[-1]]
    y, out = np.array([R0, 0.0]), []
    for low, high in pairwise(edges):
        inside = times[(times > low) & (times <= high)]
        done = solve_ivp(
            rhs,
            (low, high),
            y,
            "DOP853",
            t_eval=np.unique([*inside, high]),
            args=(low, high),
            rtol=1e-11,
            atol=[1e-18, 1e-11],
            max_step=1e-7,
        )
        assert done.success
        out.append(done.y[0, : len(inside)])
        y = done.y[:, -1]
    return np.concatenate(out)
