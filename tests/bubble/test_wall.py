"""A plane near the bubble: an independent integration, Rattray's collapse time, two equal bubbles by another code."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.integrate import solve_ivp
from scipy.special import logit

from en4dvar_bubble import WATER_25C, Accuracy, BubbleModel, get_law, simulate
from en4dvar_bubble.collapse import RAYLEIGH, lobe
from en4dvar_bubble.driving import tabulated
from en4dvar_bubble.dynamics import Wall
from en4dvar_bubble.medium import Medium
from en4dvar_bubble.starter.elsewhere import BY_VISCOSITY, plane_in_a_gel
from en4dvar_bubble.starter.guess import OF_GELS
from en4dvar_bubble.starter.look import look
from en4dvar_bubble.starter.proposal import propose

APECSS = Path(__file__).resolve().parents[3] / "shared" / "reference" / "apecss"
MEASURED = APECSS.parents[1] / "data" / "bubbles" / "stiff_polyacrylamide"
TIGHT = Accuracy(nodes=12, rtol=1e-9)
WATER = {"mu": 1e-3, "R_max": 200e-6, "R_eq": 40e-6}
TIMES = np.linspace(0, 60e-6, 241)


def path(wall, gas="polytropic", values=WATER, times=TIMES, **options):
    data = simulate("newtonian", values, times, start="laser", gas=gas, wall=wall, accuracy=TIGHT, **options)
    assert not data.status.any()
    return data.R[0].values


def scipy_path(sign, h):
    """Keller–Miksis in SI with the image's pressure ±ρ/(2h) (R² R̈ + 2 R Ṙ²), polytropic gas."""
    m, (mu, R_max, R_eq) = WATER_25C, WATER.values()
    gas = (m.p_inf + 2 * m.S / R_eq) * (R_eq / R_max) ** 3

    def rates(t, y):
        R, V = y
        p = gas * (R_max / R) ** (3 * m.kappa)
        P = p - m.p_inf - 2 * m.S / R - 4 * mu * V / R
        slope = -3 * m.kappa * p * V / R + 2 * m.S * V / R**2 + 4 * mu * V**2 / R**2  # of P, but for R̈
        right = (1 + V / m.c) * P / m.rho + R / (m.rho * m.c) * slope - 1.5 * (1 - V / (3 * m.c)) * V**2
        right -= sign * R * V**2 / h
        return V, right / ((1 - V / m.c) * R + 4 * mu / (m.rho * m.c) + sign * R**2 / (2 * h))

    return solve_ivp(rates, (0, TIMES[-1]), (R_max, 0.0), "Radau", TIMES, rtol=1e-11, atol=1e-14).y[0]


@pytest.mark.parametrize(("kind", "sign"), [("rigid", 1), pytest.param("free", -1, marks=pytest.mark.slow)])
def test_against_scipy(kind, sign):
    R, exact = path(Wall(500e-6, kind)), scipy_path(sign, 500e-6)
    assert np.abs(R - exact).max() < 2e-6 * 200e-6
    assert np.abs(path(None) - exact).max() > 1e-2 * 200e-6  # the wall is seen


def collapse_time(wall):
    """Of a bubble with hardly any gas in an ideal liquid, over R_max √(ρ/p_∞)."""
    ideal = replace(WATER_25C, S=0.0)
    values = {"mu": 0.0, "R_max": 1e-3, "R_eq": 5e-5}
    times = np.linspace(0.88, 1.1, 16_001) * 1e-3 * np.sqrt(ideal.rho / ideal.p_inf)
    R = path(wall, values=values, times=times, medium=ideal, radial="rayleigh-plesset")
    return times[np.argmin(R)] / (1e-3 * np.sqrt(ideal.rho / ideal.p_inf))


def test_rattray():
    """To first order the collapse takes 1 + 0.205 R_max/h times as long (Rattray 1951)."""
    alone, slopes = collapse_time(None), []
    assert alone == pytest.approx(RAYLEIGH, rel=2e-3)
    for h in (20e-3, 10e-3):
        slopes.append((collapse_time(Wall(h)) / alone - 1) * h / 1e-3)
    assert 2 * slopes[0] - slopes[1] == pytest.approx(0.205, abs=0.004)
    assert collapse_time(Wall(20e-3, "free")) < alone


def delayed(h, walls, R_max=200e-6, R_eq=70e-6, steps=4000):
    """Collapse time (s) in an ideal liquid between ``walls`` rigid planes, with all images and their sound's delay:
    Rayleigh–Plesset by Runge–Kutta, the growth before time zero being its mirror image.
    """
    m = WATER_25C
    t_c = RAYLEIGH * R_max * np.sqrt(m.rho / m.p_inf)
    dt = 2.5 * t_c / steps
    n = np.arange(1, 2 if walls == 1 else int(3.5 * t_c * m.c / (2 * h)) + 2)
    grid, source = dt * np.arange(steps + 1), np.zeros(steps + 1)  # d(R²Ṙ)/dt

    def images(t, known):
        sent = t - n * 2 * h / m.c
        heard = np.interp(np.minimum(np.abs(sent), grid[known]), grid[: known + 1], source[: known + 1])
        return walls / (2 * h) * np.sum(np.where(sent < -0.98 * t_c, 0.0, heard) / n)

    def rate(y, image):
        R, V = y
        P = m.p_inf * ((R_eq / R) ** (3 * m.kappa) * (R_eq / R_max) ** (3 - 3 * m.kappa) - 1)
        return np.array([V, (P / m.rho - 1.5 * V**2 - image) / R])

    y = np.array([R_max, 0.0])
    for _ in range(40):  # the images of the bubble at time zero hang on themselves
        source[0] = 0.5 * (source[0] + R_max**2 * rate(y, images(0.0, 0))[1])
    for i in range(steps):
        begin, middle, end = (images(grid[i] + part * dt, i) for part in (0, 0.5, 1))
        k1 = rate(y, begin)
        k2 = rate(y + dt / 2 * k1, middle)
        k3 = rate(y + dt / 2 * k2, middle)
        following = y + dt / 6 * (k1 + 2 * k2 + 2 * k3 + rate(y + dt * k3, end))
        if y[1] < 0 <= following[1]:
            return grid[i] + dt * y[1] / (y[1] - following[1])
        y = following
        source[i + 1] = y[0] ** 2 * rate(y, end)[1] + 2 * y[0] * y[1] ** 2
    raise AssertionError("no collapse")


def later(wall):
    """By which part the collapse comes later than without the ``wall``, of the bubble of :func:`delayed`."""
    ideal = replace(WATER_25C, S=0.0)
    values = {"mu": 0.0, "R_max": 200e-6, "R_eq": 70e-6}
    times = np.linspace(10e-6, 30e-6, 16_001)
    options = {"values": values, "times": times, "medium": ideal, "radial": "rayleigh-plesset"}
    found = [times[np.argmin(path(of, **options))] for of in (None, wall)]
    return found[1] / found[0] - 1, found[0]


@pytest.mark.parametrize("h", [0.8e-3, 1.6e-3, 4e-3])
def test_a_slit_is_the_sum_of_images_whose_sound_has_arrived(h):
    found, alone = later(Wall(h, "slit"))
    assert found == pytest.approx(delayed(h, 2) / alone - 1, rel=0.06)
    assert found > 2.5 * later(Wall(h))[0]  # far more than one plane


def test_the_delay_of_the_sound_from_one_plane_is_short():
    """At four radii it makes of 4.9 % of the collapse time 5.3."""
    found, alone = later(Wall(0.8e-3))
    assert found == pytest.approx(delayed(0.8e-3, 1) / alone - 1, rel=0.08)


@pytest.mark.parametrize("wall", [Wall(1e-3, "slit"), Wall(3.0, relative=True)])
def test_what_refers_to_the_largest_radius_needs_a_released_bubble(wall):
    with pytest.raises(ValueError, match="start: laser"):
        BubbleModel(get_law("newtonian"), wall=wall)


@pytest.mark.parametrize("gas", ["polytropic", "heat"])
def test_far_away_there_is_none(gas):
    np.testing.assert_allclose(path(Wall(1e6), gas), path(None, gas), rtol=0, atol=1e-7 * 200e-6)


def test_the_distance_may_be_a_parameter():
    law = get_law("newtonian")
    model = BubbleModel(law, "polytropic", "laser", wall=Wall(1e-3)).with_parameters(["wall_distance"])
    values = {name: np.full(2, value) for name, value in WATER.items()} | {"wall_distance": np.array([400e-6, 1e-3])}
    R = model.integrate(model.initial_states(values), np.tile(TIMES, (2, 1)))["R"]
    for i, h in enumerate(values["wall_distance"]):
        fixed = simulate("newtonian", WATER, TIMES, start="laser", gas="polytropic", wall=Wall(h))
        assert np.array_equal(R[i], fixed.R[0])
    far = simulate(
        "newtonian", WATER, TIMES, start="laser", gas="polytropic", wall=Wall(h / WATER["R_max"], relative=True)
    )
    np.testing.assert_allclose(far["R"], fixed["R"], rtol=1e-9)
    assert "wall_distance" not in [p.name for p in replace(model, wall=None, named=()).optional_parameters]
    with pytest.raises(ValueError, match="reaches the wall"):
        model.initial_states(values | {"wall_distance": np.array([150e-6, 400e-6])})  # whatever the other member has


@pytest.mark.skipif(not APECSS.exists(), reason="../shared/reference/apecss is not there")
@pytest.mark.parametrize("apart", [200, 800])
def test_two_equal_bubbles_are_one_at_a_wall(apart, tmp_path):
    """Computed by the program APECSS 1.8, without the sound's delay between the two."""
    t, R = np.loadtxt(APECSS / f"two_equal_bubbles_{apart}um.csv", delimiter=",", skiprows=1).T * 1e-6
    medium = replace(WATER_25C, rho=1000.0, c=1500.0, p_inf=1e5, S=0.0728)
    clock = np.linspace(0, t[-1], 3000)
    wave = tabulated(clock, 60e3 * np.sin(2 * np.pi * 15.7e3 * clock))
    options = {"driving": wave, "gas": "polytropic", "medium": medium, "accuracy": TIGHT}
    pair = simulate("newtonian", {"mu": 1.002e-3, "R0": 10e-6}, t[1:], wall=Wall(apart * 0.5e-6), **options).R[0].values
    assert np.abs(pair - R[1:]).max() < 1e-4 * 10e-6


@pytest.mark.parametrize(("wall", "near"), [(Wall(450e-6), True), (Wall(5.7 * 200e-6), True), (None, False)])
def test_a_slow_collapse_in_a_liquid_proposes_a_wall_that_may_be_near_or_far(wall, near):
    times = np.arange(0, 90e-6, 0.5e-6)
    R = path(wall, times=times)
    proposal = propose({"bubble": (times, R)}, "laser", "newtonian", "water")
    lines = {entry.key: entry.value for entry in (*proposal.model, *proposal.parameters)}
    assert ("wall" in lines) == ("wall_distance" in lines) == near
    if near:
        prior = yaml.safe_load(lines["wall_distance"])
        lower, upper, median = (float(prior[key].split()[0]) for key in ("lower", "upper", "median"))
        assert 210 < lower < 230  # 1.1 R_max
        for distance in (450, 20 * 200):  # where it is, and where nearly nothing is seen of it
            odds = logit((distance - lower) / (upper - lower)) - logit((median - lower) / (upper - lower))
            assert abs(odds) < 1.645 * prior["logit_std"]
    viscous = path(wall, values=WATER | {"mu": 0.5}, times=3 * times)
    assert "wall" not in {entry.key for entry in propose({"bubble": (3 * times, viscous)}, "laser", "newtonian").model}
    in_gel = propose({"bubble": (times, R)}, "laser", "neo-hookean-kelvin-voigt")
    assert "wall" not in {entry.key for entry in in_gel.model}


GEL = {"G": 8e3, "mu": 0.1, "R_eq": 40e-6, "R_max": 250e-6}


def history_in_gel(wall=None, **values):
    """Times (K,) and radius (K,) of a bubble in a gel, whose gas and vapour are those that ``init`` proposes."""
    times, options = np.arange(0, 60e-6, 0.25e-6), {"gas": "heat", "vapour": "transport", "medium_heat": "conducting"}
    data = simulate("neo-hookean-kelvin-voigt", GEL | values, times, start="laser", wall=wall, **options)
    return times, data.R[0].values


@pytest.mark.parametrize(
    ("wall", "values", "told"),
    [
        (Wall(750e-6), {}, True),  # whose G comes out as 2 kPa
        (None, {}, False),
        (None, {"G": 1e3, "mu": 0.2}, True),  # which nobody can tell from a plane
        (None, {"mu": 0.08, "R_max": 120e-6, "R_eq": 18e-6}, False),  # viscosity makes small ones slow
    ],
)
def test_a_slow_collapse_in_a_gel_tells_what_a_plane_would_do_to_its_modulus(wall, values, told):
    bubble = history_in_gel(wall, **values)
    warnings = [w for w in propose({"bubble": bubble}, "laser").warnings if "rigid plane may be nearby" in w]
    assert len(warnings) == told
    if wall is not None:
        assert "makes G too small by about 7 kPa at 3 R_max and 2 kPa at 10 R_max" in warnings[0]
        assert warnings[0].endswith("--set model.wall.distance='750 um'")
        of_several = propose({"a": history_in_gel(), "b": bubble, "c": history_in_gel()}, "laser").warnings
        (told_b,) = [w for w in of_several if w.startswith("b: the collapse takes 1.0")]
        scale = r"and 2 others [01]\.\d\d of what they would there: radii 1\.\d+ times too small, or the time step"
        assert re.search(scale, told_b)
        assert "for these files alone" in told_b  # else it would hold for every bubble of the folder
        assert "alone" not in "".join(propose({"a": bubble, "b": bubble, "c": history_in_gel()}, "laser").warnings)


def test_a_bubble_is_slow_beside_what_others_would_take_by_their_own_size():
    """Small ones take longer by viscosity, so that radii of a large one by a plane were "too large"; and what has no
    possible scale tells nothing of another's.
    """
    small, large = history_in_gel(mu=0.08, R_max=80e-6, R_eq=12e-6), history_in_gel(Wall(750e-6))
    looks = {name: look(*history, "laser") for name, history in {"a": small, "b": small, "c": large}.items()}
    (told,) = plane_in_a_gel(looks, Medium())
    assert re.search(r"^c: .*, and 2 others 1.0\d of what they would there: radii 1.\d+ times too small", told)
    looks |= {name: look(0.3 * small[0], small[1], "laser") for name in "ab"}
    (told,) = plane_in_a_gel(looks, Medium())
    assert "radii" not in told
    assert "for these files alone" in told


@pytest.mark.skipif(not MEASURED.exists(), reason="../shared/data/bubbles is not there")
@pytest.mark.parametrize(
    "name", ["pa_01", "pa_13", *(pytest.param(name, marks=pytest.mark.slow) for name in ("pa_05", "pa_15"))]
)
def test_a_history_that_begins_behind_its_top_tells_no_plane(name):
    """Its collapse begins at an instant that nobody has seen; with the growth before, it is quicker than usual."""
    table = np.genfromtxt(MEASURED / f"{name}.csv", delimiter=",", skip_header=2) * 1e-6
    behind = table[int(np.argmax(table[:, 1])) + 1 :]
    for times, radius in (table.T, behind.T):
        assert not [w for w in propose({"bubble": (times, radius)}, "laser").warnings if "plane may be nearby" in w]


@pytest.mark.parametrize("radius", [150e-6, 250e-6, 400e-6])
@pytest.mark.parametrize("rest", [0.1, 0.2])
def test_what_a_usual_gel_takes_is_what_forward_runs_say(radius, rest):
    """A hundredth is worth a kPa, and the amount of gas is known to no better."""
    medium, (G, mu) = Medium(), (OF_GELS[name][0] for name in ("G", "mu"))
    usual = 1 + BY_VISCOSITY * mu / (radius * np.sqrt(medium.rho * medium.p_inf))
    slowness = {
        modulus: lobe(*history_in_gel(G=modulus, mu=mu, R_eq=rest * radius, R_max=radius)).rayleigh_ratio(medium)
        for modulus in (G, 2 * G)
    }
    assert slowness[G] == pytest.approx(usual, abs=0.02)
    assert slowness[G] - slowness[2 * G] == pytest.approx(G / 1e5, rel=0.25)
