"""What ``init`` reads off a history, against histories whose top, errors and bad readings are known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from en4dvar.inputs.implausible import cut_off, level_top, outlying, scatter_of
from en4dvar_bubble.model import BubbleModel
from en4dvar_bubble.settings import BubbleSettings
from en4dvar_bubble.starter.look import TOP_WIDTH, Top, look, top

_PATH = solve_ivp(
    lambda _, y: [y[1], (-1 - 1.5 * y[1] ** 2) / y[0]], (0, 0.9), [1.0, 0.0], dense_output=True, rtol=1e-10
)


def history(stream: np.random.Generator, per_collapse: float, noise_std: float, grown: float) -> tuple:
    """Rayleigh's collapse, integrated, its top at 0 and 1, seen from ``grown`` before it; growth is 10 % slower."""
    t = np.arange(-grown, 0.85, 0.9147 / per_collapse) + 0.9147 / per_collapse * stream.random()
    at = np.where(t < 0, -t * (1 + 0.1 * t), t)
    return t, _PATH.sol(np.clip(at, 0, 0.89))[0] + noise_std * stream.standard_normal(len(t))


@pytest.mark.parametrize("grown", [0.0, pytest.param(0.5, marks=pytest.mark.slow), 0.8])
@pytest.mark.parametrize(("per_collapse", "noise_std"), [(9, 0.005), (20, 0.02), (60, 0.01), (60, 0.03)])
def test_the_top_lies_where_its_errors_say(per_collapse: float, noise_std: float, grown: float) -> None:
    stream = np.random.default_rng(3)
    tops: list[Top] = []
    for _ in range(40):
        t, r = history(stream, per_collapse, noise_std, grown)
        tops.append(top(t, r, noise_std))
    z = np.array([[one.time / one.time_std, (one.height - 1) / one.height_std] for one in tops])
    assert np.all(np.abs(z).mean(axis=0) < 1.2)
    assert np.mean(np.abs(z) > 3) < 0.04  # the prior takes three of them as its standard deviation
    if grown and per_collapse > 10:  # and they are errors of a fit, not those of the largest reading
        largest = np.sqrt(noise_std / 0.42) * 0.9147
        assert np.median([one.time_std for one in tops]) < 0.5 * largest


@pytest.mark.parametrize(("per_collapse", "noise_std"), [(9, 0.014), (20, 0.005), (20, 0.014), (60, 0.005), (60, 0.03)])
def test_of_a_film_that_begins_behind_the_top_its_time_is_open_by_what_readings_leave_and_no_more(
    per_collapse: float, noise_std: float
) -> None:
    """A sixth of a collapse time late: it lies within 5 to 95 % of its prior, which is no longer than the collapse."""
    stream, tops = np.random.default_rng(13), list[Top]()
    for _ in range(60):
        t, r = history(stream, per_collapse, noise_std, -0.15)
        tops.append(top(t, r, noise_std))
    prior_std = TOP_WIDTH * np.array([one.time_std for one in tops])
    assert np.mean(np.abs([one.time for one in tops]) > 1.645 * prior_std) < 0.1
    assert np.median(prior_std) < 0.45
    assert prior_std.max() < 0.9147


@pytest.mark.parametrize("grown", [0.5, 0.8])
@pytest.mark.parametrize("per_collapse", [9, 20, 60])
def test_where_readings_are_exact_the_top_is_off_by_what_growth_differs(per_collapse: float, grown: float) -> None:
    stream = np.random.default_rng(4)
    for _ in range(10):
        t, r = history(stream, per_collapse, 1e-4, grown)
        seen = top(t, r, 1e-4)
        assert abs(seen.time) < 2.5 * seen.time_std
        assert seen.time_std < 0.02


@pytest.mark.parametrize("per_collapse", [9, 20, 60])
def test_scatter_is_told_whatever_the_bubble_does(per_collapse: float) -> None:
    stream = np.random.default_rng(5)
    found = []
    for _ in range(40):
        t, r = history(stream, per_collapse, 0.01, 0.8)
        found.append(scatter_of(t, r))
    assert np.median(found) == pytest.approx(0.01, rel=0.15)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_readings_that_are_none_are_told_and_not_taken_for_the_top(count: int) -> None:
    stream = np.random.default_rng(7)
    t, r = history(stream, 30, 0.01, 0.8)
    assert not outlying(t, r, scatter_of(t, r)).any()
    where = int(np.argmin(np.abs(t - 0.35)))
    r[where : where + count] += 0.4
    odd = outlying(t, r, scatter_of(t, r))
    assert np.flatnonzero(odd).tolist() == list(range(where, where + count))
    assert look(t[~odd], 1e-4 * r[~odd]).top.height == pytest.approx(1e-4, rel=0.02)


@pytest.mark.parametrize("by", [(-0.4, 0.3, 0.25, -0.2), (0.3, 0.35, 0.25, -0.2), (0.2, -0.4, -0.25, 0.5)])
def test_wild_readings_among_wild_ones_are_told_and_no_others(by: tuple[float, ...]) -> None:
    """One in five of those about the top, so that a neighbour of each is wild, too, and the scatter seems larger."""
    for seed in range(8):
        t, r = history(np.random.default_rng(seed), 30, 0.01, 0.8)
        wild = int(np.argmin(np.abs(t))) + np.array([-7, -5, 1, 4])
        r[wild] += by
        odd = outlying(t, r, scatter_of(t, r))
        assert np.flatnonzero(odd).tolist() == wild.tolist()
        assert look(t[~odd], 1e-4 * r[~odd]).top.height == pytest.approx(1e-4, rel=0.02)


@pytest.mark.parametrize("per_collapse", [15, 30])
@pytest.mark.parametrize("ceiling", [0.9, 0.94])
def test_a_top_that_is_cut_off_is_told_and_its_height_is_that_of_the_sides(per_collapse: float, ceiling: float) -> None:
    stream = np.random.default_rng(10)
    for _ in range(10):
        t, r = history(stream, per_collapse, 0.005, 0.8)
        clipped = np.minimum(np.round(r / 0.006) * 0.006, ceiling)
        odd = cut_off(t, clipped, scatter_of(t, clipped))
        assert set(np.flatnonzero(clipped == ceiling)) <= set(np.flatnonzero(odd))
        assert np.all(r[odd] > ceiling - 0.03)
        seen = look(t[~odd], 1e-4 * clipped[~odd]).top
        assert abs(seen.height - 1e-4) < 1.645 * TOP_WIDTH * seen.height_std  # 5 to 95 % of the prior
        assert seen.height > 1.02e-4 * ceiling


def test_a_top_that_is_rounded_is_not_cut_off() -> None:
    """Several equal largest readings are what pixels make of a top."""
    stream, plateaus = np.random.default_rng(11), 0
    for per_collapse in (8, 20, 80):
        for noise_std in (0.0, 0.002, 0.01):
            for pixel in (0.005, 0.02, 0.05):
                for _ in range(10):
                    t, r = history(stream, per_collapse, noise_std, 0.8)
                    rounded = np.round(r / pixel) * pixel
                    plateaus += np.sum(rounded == rounded.max()) > 3
                    assert not cut_off(t, rounded, scatter_of(t, rounded)).any()
    assert plateaus > 100


@pytest.mark.parametrize("per_collapse", [12, pytest.param(20, marks=pytest.mark.slow), 40])
@pytest.mark.parametrize(("ceiling", "noise_std"), [(0.96, 0.003), (0.92, 0.003), (0.92, 0.006)])
def test_a_top_that_is_cut_off_and_scatters_is_told(per_collapse: float, ceiling: float, noise_std: float) -> None:
    stream, told = np.random.default_rng(12), 0
    for _ in range(20):
        t, r = history(stream, per_collapse, 0.0, 0.8)
        read = np.minimum(r, ceiling) + noise_std * stream.standard_normal(len(t))
        odd = level_top(t, read, scatter_of(t, read))
        if not odd.any():
            continue
        told += 1
        assert read[odd].min() > ceiling - 4 * noise_std
        assert np.sum(odd & (r > ceiling)) > 0.8 * np.sum(r > ceiling)
        assert not level_top(t[~odd], read[~odd], scatter_of(t[~odd], read[~odd])).any()
        seen = look(t[~odd], 1e-4 * read[~odd]).top
        assert abs(seen.height - 1e-4) < 1.645 * TOP_WIDTH * seen.height_std
    assert told > 15


@pytest.mark.slow
def test_a_top_that_scatters_is_not_level() -> None:
    stream = np.random.default_rng(13)
    for _ in range(400):
        per_collapse, noise_std = np.exp(stream.uniform(np.log([5, 0.002]), np.log([60, 0.03])))
        t, r = history(stream, per_collapse, noise_std, stream.choice([0.5, 0.8]))
        pixel = stream.choice([1e-9, 0.005, 0.02, 0.05])
        rounded = np.round(r / pixel) * pixel
        assert not level_top(t, rounded, scatter_of(t, rounded)).any()


def test_a_bubble_that_oscillates_has_no_level_top() -> None:
    stream = np.random.default_rng(14)
    for _ in range(400):
        t = np.linspace(0, 1, stream.integers(8, 200))
        cycles, amplitude, phase = stream.uniform((0.2, 0.05, 0), (8, 0.45, 2 * np.pi))
        r = 1 + amplitude * np.sin(2 * np.pi * cycles * t + phase) + 0.005 * stream.standard_normal(len(t))
        assert not level_top(t, r, scatter_of(t, r)).any()


def test_a_bubble_that_is_large_when_first_seen_is_no_nucleus() -> None:
    """Seen from 72 % of R_max to 36 %, growth from small would have been seen before."""
    t, r = history(np.random.default_rng(8), 24, 0.003, 0.65)
    kept = r > 0.36
    seen = look(24e-6 / 0.9147 * t[kept], 243e-6 * r[kept])
    assert 0.6 < r[0] < 0.8
    assert (seen.start, seen.clear) == ("laser", False)


def test_fragments_are_no_bubble_at_rest() -> None:
    """After its oscillations the radius grows from 40 to 90 µm, as that of a cloud does."""
    t = np.arange(250) * 1e-6
    r = 240e-6 * np.clip(1 - (t / 25e-6 - 1) ** 2, 0, 1) ** 0.4
    r = np.maximum(
        r, np.where(t > 51e-6, 130e-6 * np.abs(np.sin((t - 51e-6) / 8e-6)) * np.exp(-(t - 50e-6) / 15e-6), 0)
    )
    rest = np.maximum(r, 30e-6 + 1e-7 * (t > 1))
    assert look(t, rest).rest == pytest.approx(30e-6, rel=0.02)
    grows = np.maximum(r, np.where(t > 80e-6, 40e-6 + 50e-6 * (t - 80e-6) / 170e-6, 30e-6))
    seen = look(t, grows)
    assert np.isnan(seen.rest)
    assert "where it should rest" in seen.drift


@pytest.mark.parametrize("change", [0.8, 1.25])
def test_a_radius_that_changes_after_it_has_settled_drifts(change: float) -> None:
    t = np.arange(250) * 1e-6
    r = np.where(t < 26e-6, 240e-6 * np.clip(1 - (t / 25e-6) ** 2, 0, 1) ** 0.4, 0)
    r = np.maximum(r, 30e-6 + 50e-6 * np.sin((t - 26e-6) / 8e-6) ** 2 * np.exp(-(t - 26e-6) / 15e-6))
    assert look(t, r).rest == pytest.approx(30e-6, rel=0.02)
    assert "where it should rest" in look(t, r * np.where(t > 190e-6, change, 1)).drift


def test_a_rebound_that_rests_near_its_top_does_not_drift() -> None:
    """As where a file begins behind the collapse: "R goes from 42.8 to 42.8 um where it should rest"."""
    t = np.arange(120) * 1e-6
    r = 40e-6 + 20e-6 * np.sin(t / 3e-6) ** 2 * np.exp(-t / 15e-6)
    seen = look(t, r, "laser")
    assert np.isnan(seen.rest)
    assert seen.drift.startswith("R rests at 40 um, above 0.6 of its maximum, 5")


@pytest.mark.parametrize("ends", [90, 100, 129])
@pytest.mark.parametrize("largest", [220e-6, 310e-6])
def test_rebounds_that_die_away_are_no_drift(largest: float, ends: float) -> None:
    """Wherever the record ends: the quarter before the last one holds a rebound, whose median is larger."""
    settings = {"start": "laser", "law": "neo-hookean-kelvin-voigt"}
    model = BubbleModel.from_settings(BubbleSettings.model_validate(settings))
    rest, t = 48 / 310 * largest, np.arange(0, 1e-6 * ends, 0.012 * largest)
    theta = {"G": 6e3, "mu": 0.06, "R_max": largest, "R_eq": rest}
    states = model.initial_states({name: np.array([value]) for name, value in theta.items()})
    (path,) = model.trajectories(states, t)
    seen = look(t, path["R"] + 5e-7 * np.random.default_rng(1).standard_normal(len(t)))
    assert not seen.drift
    assert seen.rest == pytest.approx(rest, rel=0.1)


@pytest.mark.parametrize(("mu", "grown"), [(0.3, 0.6), (0.5, 0.0), (0.7, 0.0)])
def test_a_bubble_that_creeps_back_has_a_top_and_is_no_driven_one(mu: float, grown: float) -> None:
    """In a thick gel there is no rebound, and R^(5/2) is a parabola near the top alone."""
    settings = {"start": "laser", "law": "newtonian", "gas": "isothermal"}
    model = BubbleModel.from_settings(BubbleSettings.model_validate(settings))
    largest, t = 120e-6, np.arange(-grown * 12e-6, 60e-6, 0.9e-6)
    theta = {"mu": np.array([mu]), "R_max": np.array([largest]), "R_eq": np.array([20e-6])}
    (path,) = model.trajectories(model.initial_states(theta), t)
    seen = look(t, path["R"] + 0.004 * largest * np.random.default_rng(9).standard_normal(len(t)))
    assert seen.start == "laser"
    assert np.isnan(seen.rebound)
    assert abs(seen.top.time) < 3 * seen.top.time_std
    assert seen.top.height == pytest.approx(largest, abs=3 * seen.top.height_std)


def test_a_reading_above_a_collapse_is_far_from_its_neighbours() -> None:
    """They fall too fast for a parabola, but towards it from both sides; its R_eq was half of the true one."""
    radius = np.array([350.0, 340, 320, 290, 250, 184, 164, 142, 112, 266, 36, 63, 76, 81, 86, 90, 91, 94, 91])
    (at,) = np.flatnonzero(outlying(np.arange(19.0), radius, 1.7))
    assert radius[at] == 266
    radius[at] = 75
    assert not outlying(np.arange(19.0), radius, 1.7).any()
