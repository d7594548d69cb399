"""The bubble says how far its radial equation was stretched: the wall Mach number, also between the observations."""

import numpy as np
import pytest

from en4dvar.diagnosis.honesty.checks import validity
from en4dvar_bubble import BubbleModel


def largest_mach(end, radial="keller-miksis"):
    model = BubbleModel(radial=radial)
    theta = {"G": 500.0, "alpha": 0.03, "mu": 0.1, "R0": 0.5e-6}
    x = model.initial_states({name: np.array([value]) for name, value in theta.items()})
    (path,) = model.trajectories(x, np.linspace(5e-6, end, 12))
    return model, path, path.largest("wall_mach")


def test_collapse_exceeds_it_and_the_growth_before_does_not():
    model, _, growth = largest_mach(25e-6)
    _, path, collapse = largest_mach(40e-6)
    assert growth < 0.2
    assert collapse > 3
    assert np.max(np.abs(path["Rdot"])) / model.medium.c < 0.5 * collapse  # its peak is between the observations
    times, leverage = path.times, np.ones(12)
    never, since = np.full((4, 1), np.inf), np.full((4, 1), path.beyond(model.validity[0]))
    assert list(validity(model.validity, np.full((4, 1), growth), never, times, leverage)) == []
    (found,) = validity(model.validity, np.full((4, 1), collapse), since, times, leverage)
    assert "Mach number of the bubble wall reaches" in found.words


def test_an_incompressible_liquid_has_a_lower_limit():
    model, path, reached = largest_mach(25e-6, "rayleigh-plesset")
    assert reached == pytest.approx(np.max(np.abs(path["Rdot"])) / model.medium.c, rel=1e-12)
    assert model.validity[0].value < BubbleModel().validity[0].value < BubbleModel(radial="gilmore").validity[0].value
    assert path.largest("R") == pytest.approx(path["R"].max(), rel=1e-12)


def test_it_knows_since_when_the_wall_is_too_fast():
    """To the steps of the solver: on a grid of 1 ns the wall passes the speed of sound then."""
    model, path, _ = largest_mach(40e-6)
    x = model.initial_states(
        {k: np.array([v]) for k, v in {"G": 500.0, "alpha": 0.03, "mu": 0.1, "R0": 0.5e-6}.items()}
    )
    times = np.arange(25e-6, 40e-6, 1e-9)
    (fine,) = model.trajectories(x, times)
    passed = times[np.argmax(np.abs(fine["Rdot"]) / model.medium.c > 1.0)]
    limit = model.validity[0]
    assert path.beyond(limit) == pytest.approx(passed, abs=20e-9)
    assert model.trajectories(x, times)[:1][0].beyond(limit) == path.beyond(limit)
    assert largest_mach(25e-6)[1].beyond(limit) == np.inf


def test_an_incompressible_liquid_tells_the_first_reading_beyond():
    model, path, _ = largest_mach(40e-6, "rayleigh-plesset")
    over = np.abs(path["Rdot"]) / model.medium.c > model.validity[0].value
    expected = path.times[np.argmax(over)] if over.any() else np.inf
    assert path.beyond(model.validity[0]) == expected
