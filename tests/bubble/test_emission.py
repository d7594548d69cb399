"""The pressure at a hydrophone: against the flow through the wall, in its time and distance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from en4dvar.data.noise import noise_of
from en4dvar.data.observations import Observations
from en4dvar.data.series import Series
from en4dvar.estimation.assimilate import assimilate
from en4dvar.priors.prior import Prior, PriorTerm
from en4dvar.problem import InverseProblem
from en4dvar.schemes.settings import AssimilationSettings
from en4dvar_bubble import Accuracy, BubbleModel, NeoHookeanKelvinVoigt
from en4dvar_bubble.events import HEARD, emitted

RELEASED = BubbleModel(law=NeoHookeanKelvinVoigt(), start="laser", gas="polytropic", accuracy=Accuracy(rtol=1e-10))
DRIVEN = BubbleModel(law=NeoHookeanKelvinVoigt(), gas="polytropic", accuracy=Accuracy(rtol=1e-10))
THETA = {"G": np.array([1e4, 3e3]), "mu": np.array([0.08, 0.1]), "R_max": np.full(2, 2e-4), "R_eq": np.full(2, 4e-5)}
HELD = {"G": np.full(2, 5e4), "mu": np.full(2, 0.08), "R0": np.full(2, 1.5e-6), "p_A": np.array([-2e7, -1.5e7])}
HELD |= {"pulse_frequency": np.array([1e6, 1.1e6]), "pulse_exponent": np.array([3.7, 3.2])}
HELD |= {"pulse_delay": np.array([5e-6, 5.3e-6])}
C, R = RELEASED.medium.c, 0.03


def about(time: float, step: float = 2e-10) -> np.ndarray:
    """Five instants for each of two members, whose first derivative :data:`SLOPE` takes."""
    return np.tile(time + step * np.arange(-2, 3), (2, 1))


SLOPE = np.array([1, -8, 0, 8, -1]) / (12 * 2e-10)


@pytest.mark.parametrize(
    ("model", "theta", "times"),
    [(RELEASED, THETA, np.linspace(2e-6, 2.4e-5, 12)), (DRIVEN, HELD, np.linspace(5e-6, 1.2e-5, 12))],
    ids=["released", "driven"],
)
def test_it_is_the_wave_of_keller_and_miksis(model, theta, times):
    """The flow through the wall, R²Ṙ, is F + (R/c) F′ of a wave F(t − R/c), where F′ is r p/ρ. In an incompressible
    liquid that is the second derivative of the volume: a driving, stress, surface or gas forgotten would break it.
    """
    for radial, c in (("rayleigh-plesset", np.inf), ("keller-miksis", C)):
        of = replace(model, radial=radial, hydrophone=R).with_parameters(theta)
        initial = of.initial_states(theta)
        sides = []
        for time in times:
            path = of.integrate(initial, about(time))
            wave = R * emitted(of.integrate(initial, about(time + R / C))) / of.medium.rho
            mach = path["Rdot"][:, 2] / c
            flow = (path["R"] ** 2 * path["Rdot"]) @ SLOPE
            sides.append((flow, (1 - mach) * wave[:, 2] + (path["R"] * wave / c) @ SLOPE))
        flow, wave = np.moveaxis(np.array(sides), 1, 0)
        assert np.abs(flow).max() > 5 * np.abs(flow).min()
        np.testing.assert_allclose(wave, flow, rtol=1e-4, atol=1e-4 * np.abs(flow).max())


def test_distance_and_arrival():
    times = np.tile(np.linspace(1e-6, 2.4e-5, 9), (2, 1))
    x = RELEASED.initial_states(THETA)
    near, far = (emitted(replace(RELEASED, hydrophone=r).integrate(x, times + r / C)) for r in (0.01, 0.05))
    np.testing.assert_allclose(near, 5 * far, rtol=1e-6)
    x = DRIVEN.initial_states(HELD)
    early = replace(DRIVEN, hydrophone=R).integrate(x, np.tile([1e-6, 0.9 * R / C], (2, 1)))
    np.testing.assert_allclose(emitted(early), 0.0, atol=1e-6)  # nothing has arrived
    path = replace(RELEASED, hydrophone=R).integrate(RELEASED.initial_states(THETA), times + R / C)
    np.testing.assert_array_equal(HEARD.operator(path[1]), HEARD.operator(path)[1])


def test_the_largest_is_sent_at_the_collapse():
    model = replace(RELEASED, hydrophone=R)
    times = np.linspace(1.5e-5, 2.4e-5, 4001)
    x = RELEASED.initial_states(THETA)
    pressure = emitted(model.integrate(x, np.tile(times + R / C, (2, 1))))
    radius = RELEASED.integrate(x, np.tile(times, (2, 1)))["R"]
    for p, r in zip(pressure, radius, strict=True):
        assert abs(times[np.argmax(p)] - times[np.argmin(r)]) < 2e-8


def test_a_resumed_path_has_sent_what_nobody_knows():
    x = RELEASED.initial_states(THETA)
    with pytest.raises(ValueError, match="whole paths"):
        emitted(RELEASED.integrate(x, np.full((2, 1), 2e-5), t0=1e-5))


def test_a_camera_and_a_hydrophone_together():
    """Each at times of its own; the gel is known better than from the camera alone."""
    model = replace(RELEASED, hydrophone=R)
    radius, parameters = model.observables[0], {p.name: p for p in model.parameters}
    prior = Prior(tuple(PriorTerm.lognormal(parameters[k], m, 0.5) for k, m in (("G", 6e3), ("mu", 0.06))))
    fixed = {"R_max": 2e-4, "R_eq": 4e-5}
    truth = model.initial_states({k: v[:1] for k, v in THETA.items()})
    frames, heard = np.linspace(1e-6, 1.4e-5, 6), R / C + np.linspace(1e-6, 2.1e-5, 15)
    told = []
    for seen, times, std in ((radius, frames, 2e-6), (HEARD, heard, 40.0)):
        values = seen.operator(model.integrate(truth, times[None]))[0]
        told.append(Series(seen, times, values, noise_of(np.full(len(times), std))))
    spreads = []
    for given in (told[:1], told):
        problem = InverseProblem(model, radius, Observations.of_series(given, name="one"), prior, fixed)
        found = assimilate(problem, AssimilationSettings(what_if=False, refine="none"), 1)
        spreads.append(np.log(found.posterior).std(axis=0))
        assert np.all(np.abs(np.log(found.centre / [1e4, 0.08])) < 4 * spreads[-1])
    assert np.all(spreads[1] < 0.7 * spreads[0]), spreads
