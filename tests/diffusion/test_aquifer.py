"""The aquifer against closed forms, and a field that localisation finds where the whole ensemble does not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from en4dvar.descent.field import field_en4dvar
from en4dvar.descent.field_data import FieldData
from en4dvar.priors.field_prior import FieldPrior
from en4dvar.schemes.local_gain import ByDistance
from en4dvar_diffusion import Aquifer
from en4dvar_diffusion.synthetic import readings


def test_steady_heads_are_those_of_poissons_equation():
    """h at the centre of a square of side L with h = 0 around it is 0.0736713 recharge L²/T: Timoshenko's series."""
    side = 41
    cell = np.array([side**2 // 2])
    head = Aquifer((side, side), 50.0).heads(np.full((1, side**2), np.log(2.0)), cell, np.array([3000.0]))[0, 0]
    assert head == pytest.approx(0.0736713 * 0.01 * side**2 / 2, rel=2e-3)


def test_heads_between_strips_are_those_in_series():
    """Steady flow through strips of T across x obeys d/dx(T dh/dx) = −recharge far from the ends of a long strip."""
    rows, columns = 400, 20
    T = np.where(np.arange(columns) < 10, 1.0, 4.0)
    middle = rows // 2 * columns + np.arange(columns)
    head = Aquifer((rows, columns), 200.0).heads(np.log(np.tile(T, rows))[None], middle, np.array([16000.0]))[0]
    # by hand: T h' = c − recharge x, h continuous, h(0) = h(20) = 0
    c = (0.01 * 10**2 / 2 + 0.01 * (20**2 - 10**2) / 8) / (10 + 10 / 4)
    assert np.diff(head[:10]) == pytest.approx(c - 0.01 * np.arange(1, 10), rel=5e-3)
    assert np.diff(head[10:]) == pytest.approx((c - 0.01 * np.arange(11, 20)) / 4, rel=5e-3)
    assert head[10] - head[9] == pytest.approx((c - 0.1) * (0.5 + 0.5 / 4), rel=5e-3)


def test_a_clock_that_begins_before_the_model_moves_nothing_later():
    aquifer, times = Aquifer((6, 5)), np.array([-1.0, 3.0, 9.0])
    state = aquifer.initial_state(aquifer.defaults)[None]
    (path,), (later,) = aquifer.trajectories(state, times), aquifer.trajectories(state, times[1:])
    assert np.all(path["head"][0] == 0)
    np.testing.assert_allclose(path.states[1:], later.states, rtol=1e-12)


def test_the_state_goes_on_where_it_is():
    """A step from each instant to the next ends where the whole path ends."""
    aquifer = Aquifer((6, 5))
    state = aquifer.initial_state(aquifer.defaults)
    state[aquifer.layout["ln_T"]] = np.random.default_rng(0).standard_normal(30)
    times = np.array([0.0, 1.0, 4.0, 9.0])
    (path,) = aquifer.trajectories(state[None], times)
    assert np.all(path["head"][0] == 0)
    for k in (1, 2, 3):
        state = aquifer.step(state, times[k - 1], times[k])
        assert np.max(np.abs(state - path.states[k])) < 1e-13


@pytest.mark.parametrize("power", [-40, 40])
def test_heads_do_not_depend_on_the_unit_of_time(power):
    """T and recharge are per time: in a unit 2^power times as long both are as many times as large, times as small."""
    times, ln_T, unit = np.array([1.0, 3.0, 7.3]), 0.5 * np.random.default_rng(3).standard_normal(30), 2.0**power

    def heads(unit):
        aquifer = Aquifer((6, 5), 2.0 / unit)
        state = aquifer.initial_state({"recharge": 0.01 * unit, "storage": 0.1})
        state[aquifer.layout["ln_T"]] = ln_T + np.log(unit)
        (path,) = aquifer.trajectories(state[None], times / unit)
        return path["head"]

    np.testing.assert_allclose(heads(unit), heads(1.0), rtol=1e-10)


def test_heads_of_a_state_of_whole_numbers_are_no_whole_numbers():
    aquifer, times = Aquifer((3, 3)), np.array([1.0, 5.0])
    state = aquifer.initial_state({"recharge": 1, "storage": 1})
    exact, other = (aquifer.trajectories(x[None], times)[0]["head"] for x in (state, state.astype(int)))
    np.testing.assert_allclose(other, exact, rtol=1e-12)


def test_the_shipped_readings_are_those_of_the_command():
    file = Path(__file__).parents[2] / "configs/data/aquifer_heads.csv"
    assert readings() == file.read_text(encoding="utf-8")


def test_a_field_is_found_by_localised_en4dvar():
    rng, shape = np.random.default_rng(2), (20, 20)
    aquifer, wells, times = Aquifer(shape), np.sort(rng.choice(400, 40, replace=False)), np.array([4.0, 12.0])
    field = FieldPrior(aquifer.layout.fields[1], 1.0, "gaussian", 4.0)
    truth, *prior = (field.draw(2, i) for i in range(31))
    ensemble, heads = np.array(prior), aquifer.heads(truth[None], wells, times)[0]
    std = np.full(len(heads), 0.01 * heads.max())
    y = heads + std * rng.standard_normal(len(heads))
    data = FieldData(y, std, lambda fields: aquifer.heads(fields, wells, times))
    observed = np.tile(aquifer.places[wells], (2, 1))
    before = np.sqrt(np.mean((ensemble.mean(axis=0) - truth) ** 2))
    end = field_en4dvar(ensemble, data, ByDistance(aquifer.places, observed, 8.0), max_iterations=5)
    error = np.sqrt(np.mean((ensemble.mean(axis=0) - truth) ** 2))
    spread = np.sqrt(np.mean(ensemble.var(axis=0, ddof=1)))
    assert end.costs[-1] < 0.2 * end.costs[0]
    assert error < 0.6 * before
    assert 0.7 < spread / error < 2.5
