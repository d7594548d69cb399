"""Collapses and rebounds of a bubble: against dense paths, and as readings that tell the gel."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.io import loadmat

from en4dvar.data.noise import noise_of
from en4dvar.data.observations import Observations
from en4dvar.data.series import Series
from en4dvar.ensemble.forecast import forecast
from en4dvar.estimation.assimilate import assimilate
from en4dvar.plumbing.errors import DataError
from en4dvar.priors.prior import Prior, PriorTerm
from en4dvar.problem import InverseProblem
from en4dvar.schemes.settings import AssimilationSettings
from en4dvar_bubble import BubbleModel, NeoHookeanKelvinVoigt, get_law
from en4dvar_bubble.driving import gaussian
from en4dvar_bubble.events import events

ROOT = Path(__file__).resolve().parents[2]
POOL = ROOT.parent / "shared" / "data" / "LHS-simpool-x36_KV.mat"
MODEL = BubbleModel(law=NeoHookeanKelvinVoigt(), start="laser", gas="polytropic")
OBSERVED = {one.name: one for one in MODEL.observables}
THETA = {"G": np.array([1e4, 3e3]), "mu": np.array([0.05, 0.1]), "R_max": np.full(2, 2e-4), "R_eq": np.full(2, 3e-5)}


@pytest.fixture(scope="module")
def paths():
    return MODEL.integrate(MODEL.initial_states(THETA), np.tile([2.5e-5], (2, 1)))


def test_events_are_where_dense_paths_turn(paths):
    found = events(paths)
    assert np.all(np.diff(found["time"][:, :4]) > 0)
    for i in range(2):
        for event in (1, 2, 3):
            middle = found["time"][i, event]
            near = middle + np.linspace(-20e-9, 20e-9, 801)
            radius = MODEL.integrate(paths.initial[[i]], near[None])["R"][0]
            turn = np.argmax(radius) if event == 2 else np.argmin(radius)
            if event == 2:  # flat: the speed of the wall changes its sign there
                speed = MODEL.integrate(paths.initial[[i]], middle + np.array([[-1e-10, 1e-10]]))["Rdot"][0]
                assert speed[0] > 0 > speed[1]
            else:
                assert near[turn] == pytest.approx(middle, abs=1e-10)
            assert found["radius"][i, event] == pytest.approx(radius[turn], rel=1e-4)
    assert found["radius"][:, 0] == pytest.approx(THETA["R_max"])


def test_what_is_read_does_not_depend_on_when(paths):
    whole = MODEL.integrate(paths.initial, np.tile(np.linspace(1e-6, 2.5e-5, 5), (2, 1)))
    for name in ("collapse_time", "rebound_radius", "period"):
        read = OBSERVED[name].operator(whole)
        assert read.shape == (2, 5)
        assert read == pytest.approx(np.tile(OBSERVED[name].operator(paths), (1, 5)), rel=1e-6)
        assert OBSERVED[name].operator(whole[1]) == pytest.approx(read[1], rel=1e-12)
    assert np.isnan(OBSERVED["collapse_time_3"].operator(MODEL.integrate(paths.initial, np.full((2, 1), 1e-5)))).all()


def test_events_stay_where_they_are_in_a_record_that_is_long_beside_them(paths):
    """A collapse and a rebound between two instants of a grid were none, and the second collapse the fourth."""
    found, long = events(paths), events(MODEL.integrate(paths.initial, np.tile([4e-3], (2, 1))))
    assert long["time"][:, :4] == pytest.approx(found["time"][:, :4], rel=1e-5)
    assert long["radius"][:, :4:2] == pytest.approx(found["radius"][:, :4:2], rel=1e-5)


def test_the_largest_radius_of_a_fast_bubble_is_found():
    """One that is pressed together rings eighty times in the record."""
    model = BubbleModel(law=get_law("newtonian"), gas="polytropic", driving=gaussian(3e5, 4e-6, 0.5e-6))
    paths = model.integrate(
        model.initial_states({"mu": np.full(1, 2e-3), "R0": np.full(1, 1.22e-6)}), np.array([25e-6])
    )
    times = np.linspace(0, 25e-6, 20001)
    dense = model.integrate(paths.initial, times)["R"][0]
    found = events(paths)
    assert found["radius"][0, 0] == pytest.approx(dense.max(), rel=1e-6)
    assert found["time"][0, 0] == pytest.approx(times[np.argmax(dense)], abs=2e-9)


def test_a_resumed_path_has_no_events(paths):
    resumed = MODEL.integrate(paths.initial, np.full((2, 1), 2e-5), t0=1e-5)
    with pytest.raises(ValueError, match="whole paths"):
        events(resumed)


def series(name: str, times: np.ndarray, values: np.ndarray, std: float) -> Series:
    return Series(OBSERVED[name], times, values, noise_of(np.full(len(times), std)))


def test_a_photodiode_and_a_few_frames_together():
    """Radii of half the path, one collapse time and one rebound: better than the radii alone."""
    parameters = {p.name: p for p in MODEL.parameters}
    terms = [PriorTerm.lognormal(parameters["G"], 6e3, 0.6), PriorTerm.lognormal(parameters["mu"], 0.06, 0.5)]
    fixed = {"R_max": 2e-4, "R_eq": 3e-5}
    frames = np.linspace(1e-6, 1.4e-5, 6)
    truth = MODEL.integrate(MODEL.initial_states({k: v[:1] for k, v in THETA.items()}), np.array([[*frames, 2e-5]]))
    last = np.array([2e-5])
    radii = series("radius", frames, truth["R"][0, :6], 2e-6)
    told = [
        series(name, last, OBSERVED[name].operator(truth)[0, :1], std)
        for name, std in (("collapse_time", 2e-8), ("rebound_radius", 3e-6))
    ]
    spreads = []
    for given in ([radii], [radii, *told]):
        data = Observations.of_series(given, name="one")
        problem = InverseProblem(MODEL, given[0].observable, data, Prior(tuple(terms)), fixed)
        found = assimilate(problem, AssimilationSettings(what_if=False, refine="none"), 1)
        spreads.append(np.log(found.posterior).std(axis=0))
        assert np.all(np.abs(np.log(found.centre / [1e4, 0.05])) < 4 * spreads[-1])
    assert np.all(spreads[1] < 0.5 * spreads[0])


def test_one_reading_is_a_data_set():
    one = np.ones(1)
    data = Observations(2e-5 * one, 1.7e-5 * one, noise_of(1e-8 * one), one, name="one")
    G = next(p for p in MODEL.parameters if p.name == "G")
    fixed = {"mu": 0.05, "R_max": 2e-4, "R_eq": 3e-5}
    problem = InverseProblem(MODEL, OBSERVED["collapse_time"], data, Prior((PriorTerm.lognormal(G, 1e4, 0.3),)), fixed)
    run = forecast(problem, np.log([[5e3], [2e4]]))
    assert run.predictions[0, 0] > run.predictions[1, 0]  # the stiffer one is sooner back
    assert not {"length_scale", "time_scale"} & {one.name for one in problem.alternatives}  # those of a camera
    assert {"length_scale", "time_scale"} <= {
        one.name for one in replace(problem, observable=MODEL.observables[0]).alternatives
    }
    with pytest.raises(DataError, match="no usable observation"):
        replace(data, times=one[:0], values=one[:0], weights=one[:0], noise=noise_of(one[:0]))


def test_a_bubble_that_creeps_is_excluded_by_its_collapse_and_not_lost():
    """In a liquid of 2 Pa s none collapses within twice the time that was read."""
    one = np.ones(1)
    data = Observations(2e-5 * one, 2e-5 * one, noise_of(1e-7 * one), one, name="one")
    terms = [PriorTerm.lognormal(p, 0.1, 1.2) for p in MODEL.parameters if p.name == "mu"]
    fixed = {"G": 5e3, "R_max": 2e-4, "R_eq": 3e-5}
    problem = InverseProblem(MODEL, OBSERVED["collapse_time"], data, Prior(tuple(terms)), fixed)
    found = assimilate(problem, AssimilationSettings(members=100, what_if=False, refine="none"), seed=1)
    lost = [c for c in found.cautions if c.code == "members-lost"]
    assert lost
    assert {c.severity for c in lost} == {"note"}
    assert all("lack the event in the" in c.words and "mu above" in c.words for c in lost)


def test_a_path_that_cannot_be_followed_fails():
    with pytest.raises(ValueError, match="cannot be followed"):
        OBSERVED["collapse_time"].operator({"time of collapse 1": np.full((2, 1), np.inf)})


@pytest.mark.slow
@pytest.mark.skipif(not POOL.exists(), reason="LHS-simpool-x36_KV.mat is not there (../shared/data)")
def test_one_gel_from_collapse_times(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    from collapse_times import misfit, one_gel, published

    campaign = loadmat(POOL)["pIMR_array"][::4]
    found = one_gel(campaign, 1e-4, 10e-9)
    G, mu, _ = published(campaign)
    assert found.shared.mean(axis=0) == pytest.approx([G, mu], rel=0.1)
    assert 0.3 < misfit(found) < 3
    sys.modules.pop("collapse_times", None)
