"""Scales that cannot be: the collapse time beside Rayleigh's, in public data and in forward runs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from init_files import rebounding
from scipy.io import loadmat

from en4dvar_bubble import BubbleModel, collapse
from en4dvar_bubble.collapse import EXTREME, RAYLEIGH, Expected, Gel, Lobe, bounds, conceivable, doubt, doubts, lobe
from en4dvar_bubble.medium import WATER_25C
from en4dvar_bubble.settings import BubbleSettings

MEASURED = Path(__file__).resolve().parents[3] / "shared" / "data"
FRAME, PIXEL = 3.7037e-6, 2.76e-6


def measured(name: str) -> Path:
    if not (MEASURED / name).exists():
        pytest.skip(f"{MEASURED / name} is not here")
    return MEASURED / name


def usual(ratio: float, R_max: float = 400e-6) -> Lobe:
    return Lobe(R_max, 0.0, ratio * RAYLEIGH * R_max * np.sqrt(WATER_25C.rho / WATER_25C.p_inf))


def test_metres_that_are_pixels_times_seconds_are_noticed_and_explained() -> None:
    """PA1_exp2 as stored: 3.7037/2.76 = 1.342 times too large."""
    data = loadmat(measured("PA1_exp2_RofTdata_0.mat"))
    t, R = data["t"].ravel(), data["Rnew"].ravel()
    told = doubt(lobe(t, R), WATER_25C)
    assert "0.76 of the Rayleigh time" in told
    factor = float(told.split("radii ")[1].split()[0])
    assert factor == pytest.approx(FRAME / PIXEL, rel=0.02)
    assert doubt(lobe(t, R * PIXEL / FRAME), WATER_25C) == ""


def test_diameters_given_as_radii_are_noticed() -> None:
    data = loadmat(measured("PAstiff_xy002_RofT.mat"))
    R = data["Rnew"].ravel()
    R = R[np.argmax(R > 0) :] * PIXEL
    t = FRAME * np.arange(len(R))
    assert doubt(lobe(t, R), WATER_25C) == ""
    assert "diameters given as radii?" in doubt(lobe(t, 2 * R), WATER_25C)
    assert "radii 2.62 times" in doubt(lobe(t, R / PIXEL * 1e-6), WATER_25C)  # pixels taken for micrometres
    assert "too small" in doubt(lobe(t, R / PIXEL * 1e-6), WATER_25C)


def test_correct_public_data_are_believed() -> None:
    data = loadmat(measured("A_E2_002.mat"))
    t, R = data["t"].ravel(), data["R"].ravel() * 1e-6
    ok = np.isfinite(R) & np.isfinite(t)
    assert doubt(lobe(t[ok], R[ok]), WATER_25C) == ""
    diameters = doubt(lobe(t[ok], 2 * R[ok]), WATER_25C)
    assert "0.52 of the Rayleigh time" in diameters
    assert "diameters given as radii?" in diameters
    for name in ("LHS-simpool-x36_KV.mat", "pIMR_PA_10_Refined.mat"):
        for R_max, _, t_c in loadmat(measured(name))["pIMR_array"]:
            assert doubt(Lobe(R_max, 0.0, t_c), WATER_25C) == ""


@pytest.mark.parametrize("radius", [20e-6, 50e-6, 200e-6, 500e-6])
def test_no_forward_run_of_a_gel_is_doubted(radius: float) -> None:
    """The bounds are those of the model itself, for stiffnesses and viscosities in turn taken for the largest."""
    settings = {
        "start": "laser",
        "law": "neo-hookean-kelvin-voigt",
        "gas": "polytropic",
        "vapour_pressure": "saturated",
    }
    model = BubbleModel.from_settings(BubbleSettings.model_validate(settings))
    times = np.linspace(0, 4 * RAYLEIGH * radius * np.sqrt(998 / 101325), 400)
    for G, mu, stretch in [(g, m, s) for g in (100.0, 2e4, 4.2e4) for m in (1e-3, 0.03, 0.1, 0.3) for s in (5.0, 12.0)]:
        theta = {"G": G, "mu": mu, "R_eq": radius / stretch, "R_max": radius}
        (path,) = model.trajectories(model.initial_states({k: np.array([v]) for k, v in theta.items()}), times)
        low, high = bounds(radius, model.medium, Gel(G, mu))
        if radius * np.sqrt(998 * 101325) / mu > 5:  # below, the bubble creeps back and does not collapse
            assert low < lobe(times, path["R"]).rayleigh_ratio(model.medium) < high, theta


def test_gels_beyond_what_is_usual_are_conceivable() -> None:
    """80 kPa shorten a collapse to 0.58 of Rayleigh's; a diameter taken for a radius halves it."""
    stiff = bounds(400e-6, WATER_25C, Gel(80e3, 0.1))[0]
    assert stiff == pytest.approx(0.58, abs=0.01)
    assert conceivable(usual(stiff), WATER_25C)
    assert not conceivable(usual(0.5), WATER_25C)
    unsure = replace(usual(0.53), margin=0.1)
    assert bounds(unsure.R_max, WATER_25C, EXTREME)[0] < 0.53 * 1.1
    assert not conceivable(unsure, WATER_25C)  # readings that scatter: still a diameter sooner than such a gel
    assert not conceivable(usual(3.0, 600e-6), WATER_25C)


def expected(ratios: list[float], common: bool = False) -> Expected:
    return Expected(np.array(ratios), np.full(len(ratios), common))


def test_a_prior_that_expects_it_is_believed() -> None:
    assert "radii 1.34 times too large, or the time step 1.34 times too short" in doubt(usual(0.76), WATER_25C)
    stiff = expected([0.74, 0.9, 0.95])
    assert "1.34 times" in doubt(usual(0.76), WATER_25C, stiff)  # stiffer than gels are, and wide enough to hold it
    assert doubt(usual(0.76), WATER_25C, expected([0.7, 0.76, 0.95])) == ""
    assert "the prior expects 0.90 to 0.98" in doubt(usual(1.1), WATER_25C, expected([0.9, 0.94, 0.98]))
    assert doubt(usual(1.0), WATER_25C, expected([0.9, 0.94, 0.98])) == ""


def test_a_law_by_which_a_soft_gel_collapses_so_fast_is_believed() -> None:
    """As the quadratic law does, whose spring no bound of a neo-Hookean one holds for."""
    assert doubt(usual(0.76), WATER_25C, expected([0.74, 0.9, 0.95], common=True)) == ""
    assert doubt(usual(0.76), WATER_25C, expected([0.85, 0.9, 0.95], common=True))
    viscous = 1.05 * bounds(400e-6, WATER_25C)[1]
    assert doubt(usual(viscous), WATER_25C, expected([1.0, viscous + 0.1, 1.0], common=True)) == ""
    assert doubt(usual(viscous), WATER_25C, expected([1.0, viscous + 0.1, 1.0]))


def test_which_member_is_a_common_gel() -> None:
    members = {"G": np.array([1e3, 1e5, 1e3]), "mu": np.array([0.1, 0.1, 1.0]), "R_eq": np.full(3, 1e-5)}
    assert collapse._common(members, 3).tolist() == [True, False, False]
    assert collapse._common({"R_eq": members["R_eq"]}, 3).all()


def test_ratios_of_the_prior_are_seldom_doubted() -> None:
    """A ratio drawn as the members are lies beyond the range of 48 in one set in 25."""
    rng = np.random.default_rng(3)
    doubted = 0
    for _ in range(400):
        *members, truth = 1.02 * np.exp(0.04 * rng.standard_normal(49))
        doubted += doubt(usual(truth), WATER_25C, expected(members)) != ""
    assert doubted == 0
    assert doubt(usual(1.02 * 1.34), WATER_25C, expected(members))
    assert doubt(usual(1.02 / 1.34), WATER_25C, expected(members))


def test_the_margin_is_that_of_the_scatter() -> None:
    """99 % to either side: of 400 noisy collapses some 4 lie beyond it on each."""
    rng, view = np.random.default_rng(1), usual(0.9)
    t = np.linspace(-0.2, 0.95, 9) * view.t_c
    R = view.R_max * (1 - (t / view.t_c) ** 2) ** 0.4
    found = [lobe(t, R + 0.01 * view.R_max * rng.standard_normal(9)) for _ in range(400)]
    z = [np.log(one.rayleigh_ratio(WATER_25C) / 0.9) / one.margin for one in found]
    assert 0 < np.sum(np.greater(z, 1)) < 14
    assert 0 < np.sum(np.less(z, -1)) < 14
    assert lobe(t, R).margin < 1e-9


@pytest.mark.parametrize("factor", [1e3, 1e-3])
def test_a_wrong_unit_is_asked_for(factor: float) -> None:
    assert "are the units of both columns right?" in doubt(usual(factor), WATER_25C)


def test_of_a_bubble_in_mm_no_viscosity_explains_the_slowness() -> None:
    """No bound holds for so small a bubble: in a thick gel it creeps."""
    words = doubt(usual(1e3, 0.4e-6), WATER_25C)
    assert words.startswith("the collapse takes 1000 of the Rayleigh time")
    assert "(are the units of both columns right?), or the gel is thicker" in words
    assert "allows" not in words


def test_members_that_rest_are_no_reason_to_believe_a_wrong_unit() -> None:
    """They move by a hundredth, as at the end of a growth, whose parabola is no collapse."""
    view = usual(1e-3)
    t = np.linspace(0, view.t_c, 40)
    R = view.R_max * (1 - (t / view.t_c) ** 2) ** 0.4
    resting = np.full((2, 40), view.R_max) * (1 - 0.01 * (t / view.t_c) ** 2)
    (told,) = doubts(t, R, resting, {}, WATER_25C)
    assert "are the units of both columns right?" in told.words


def test_a_window_that_ends_before_the_collapse_tells_nothing() -> None:
    view = usual(0.5)
    t = np.linspace(0, view.t_c, 40)
    R = view.R_max * (1 - (t / view.t_c) ** 2) ** 0.4
    predicted = np.stack([R, R])
    medium = replace(WATER_25C, S=0.07)
    assert doubts(t, R, predicted[:0], {}, medium)
    assert doubts(t[:20], R[:20], predicted[:0, :20], {}, medium) == ()
    assert doubts(t, R, predicted, {}, medium) == ()


def test_a_gel_stiffer_than_usual_is_told_and_its_estimate_printed() -> None:
    """A caution where the prior reaches the ratio; serious where it does not, or where no gel does."""

    def path(ratio: float) -> np.ndarray:
        view = usual(ratio)
        return view.R_max * np.clip(1 - (t / view.t_c) ** 2, 0.05, None) ** 0.4

    t = np.linspace(0, 0.95 * usual(0.7).t_c, 60)
    members = {"G": np.array([1e3, 5e3, 6e4])}
    wide = np.stack([path(ratio) for ratio in (0.98, 0.93, 0.68)])
    narrow = np.stack([path(ratio) for ratio in (0.98, 0.97, 0.96)])
    (doubt_of_wide,) = doubts(t, path(0.7), wide, members, WATER_25C)
    (doubt_of_narrow,) = doubts(t, path(0.7), narrow, {"G": np.full(3, 1e3)}, WATER_25C)
    assert (doubt_of_wide.severity, doubt_of_narrow.severity) == ("caution", "serious")
    assert "a gel of 20 kPa allows no less than 0.82" in doubt_of_wide.words
    (impossible,) = doubts(t, path(0.45), wide, members, WATER_25C)
    assert impossible.severity == "serious"


@pytest.mark.parametrize("step", [0.03, pytest.param(0.07, marks=pytest.mark.slow), 0.15])
@pytest.mark.parametrize("lost", [(0, 1), (0, 2), (-1, 1), (-1, 2)])
def test_a_collapse_that_no_frame_shows_has_its_time(step: float, lost: tuple[int, int]) -> None:
    """The frame of the minimum, and those beside it, are not there: the readings behind the gap are the rebound's."""
    for offset in np.linspace(0, step, 7):
        t, R = rebounding(step, offset)
        least = int(np.argmin(np.where(t < 1.3, R, 1.0)))
        gap = slice(least + lost[0], least + lost[1])
        with_gap = np.delete(t, gap), np.delete(R, gap)
        assert lobe(*with_gap).t_c == pytest.approx(RAYLEIGH, rel=0.06)
        behind = int(np.searchsorted(with_gap[0], t[least])) + 1
        assert lobe(*(it[:behind] for it in with_gap)).t_c == pytest.approx(RAYLEIGH, rel=0.06)  # it ends there


def test_what_one_collapse_alone_tells_of_a_law_is_an_upper_limit() -> None:
    """Said of a laser's bubble until the top of the rebound is read, or none comes; not where the law is known."""
    t = np.arange(0, 120e-6, 1e-6)
    model = BubbleModel.from_settings(
        BubbleSettings.model_validate({"law": "neo-hookean-kelvin-voigt", "start": "laser"})
    )

    def told(mu: float, end: int, members: tuple[float, float] = (0.01, 0.1)) -> list[str]:
        known = {"G": 2e3, "mu": mu, "R_max": 200e-6, "R_eq": 30e-6}
        (path,) = model.trajectories(model.initial_state(known)[None], t)
        R = path.states[:end, 0]
        cautions = model.doubts("radius", t[:end], R, np.stack([R, R]), {"mu": np.array(members)})
        return [c.code for c in cautions if c.parameters == ("mu",)]

    assert told(0.01, 21) == told(0.01, 24) == ["model-validity"]
    assert told(0.01, 80) == told(0.5, 119) == told(0.01, 21, (0.01, 0.01)) == []
