"""The test-bed models against an independent integration and against what is known of them."""

from __future__ import annotations

import importlib
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import en4dvar_lorenz
from en4dvar.data.noise import noise_of
from en4dvar.data.observations import Observations
from en4dvar.ensemble.forecast import NO_TIMES, forecast, plotting_times
from en4dvar.model.forward import Failure
from en4dvar.priors.prior import Prior, PriorTerm
from en4dvar.problem import InverseProblem
from en4dvar_lorenz import Linear, Lorenz63, Lorenz96
from en4dvar_lorenz.autonomous import Logarithm
from en4dvar_lorenz.linear import LinearSettings
from en4dvar_lorenz.lorenz63 import Lorenz63Settings
from en4dvar_lorenz.lorenz96 import Lorenz96Settings

RNG = np.random.default_rng


def lorenz63(**settings):
    return Lorenz63.from_settings(Lorenz63Settings(**settings))


def lorenz96(**settings):
    return Lorenz96.from_settings(Lorenz96Settings(**settings))


def linear(**settings):
    return Linear.from_settings(LinearSettings(**settings))


MODELS = {"lorenz63": lorenz63(), "lorenz96": lorenz96(size=7), "linear": linear(oscillators=3)}
THETA = {"sigma": 10.0, "rho": 28.0, "beta": 8 / 3, "F": 8.0, "gamma": 0.3}


def state(model, x=None):
    start = model.initial_state(THETA)
    if x is not None:
        start[: len(x)] = x
    return start


@pytest.mark.parametrize("kind", [int, np.float32, ">f8"])
@pytest.mark.parametrize("name", MODELS)
def test_a_state_of_other_numbers_is_integrated_in_double_precision(name, kind):
    """Whole numbers were integrated in whole numbers."""
    model, times = MODELS[name], np.array([0.1, 0.3])
    start = np.arange(1.0, model.layout.size + 1)
    expected = model.trajectories(start[None], times)[0].states
    assert np.ptp(expected[:, 0]) > 0.01
    other = start.astype(kind)
    np.testing.assert_allclose(model.trajectories(other[None], times)[0].states, expected, rtol=1e-12)
    np.testing.assert_allclose(model.step(other, 0.0, 0.1), expected[0], rtol=1e-12)


@pytest.mark.parametrize("name", MODELS)
def test_a_clock_that_begins_before_the_model_moves_nothing_later(name):
    """As a negative t_s makes it: paths began at their first instant, however early, instead of time zero."""
    model, times = MODELS[name], np.array([-0.1, 0.1, 0.3])
    start = state(model, np.arange(1.0, 4.0))
    before, *later = model.trajectories(start[None], times)[0].states
    np.testing.assert_allclose(later, model.trajectories(start[None], times[1:])[0].states, rtol=1e-4)
    np.testing.assert_allclose(model.step(before, -0.1, 0.0), start, rtol=1e-3, atol=1e-3)


def test_a_plot_of_a_chaotic_path_does_not_change_it():
    """Other steps between more instants led to another path: readings fitted to 0.8 of their errors, χ² of 193 told."""
    model, times = lorenz63(), np.arange(0.25, 15.1, 0.25)
    data = Observations(times, np.zeros(60), noise_of(np.ones(60)), np.ones(60))
    prior = Prior((PriorTerm.normal(model.parameters[0], 10.0, 0.1),))
    problem = InverseProblem(model, model.observables[0], data, prior, {"rho": 28.0, "beta": 8 / 3})
    alone, drawn = (forecast(problem, prior.mean[None], None, t) for t in (NO_TIMES, plotting_times(problem)))
    np.testing.assert_allclose(alone.predictions, drawn.predictions, rtol=1e-6)


def lorenz63_by_hand(t, v):
    x, y, z = v
    return [10 * (y - x), x * (28 - z) - y, x * y - 8 / 3 * z]


def lorenz96_by_hand(t, x):
    return (np.roll(x, -1) - np.roll(x, 2)) * np.roll(x, 1) - x + 8.0


@pytest.mark.parametrize(
    ("model", "by_hand", "x", "step"),
    [
        (lorenz63, lorenz63_by_hand, np.array([1.5, -1.5, 25.0]), 0.004),
        (lorenz96, lorenz96_by_hand, 3 * RNG(0).standard_normal(40), 0.02),
    ],
)
def test_against_scipy_with_the_order_of_the_method(model, by_hand, x, step):
    times = np.array([0.2, 0.5, 1.0])
    exact = solve_ivp(by_hand, (0, 1), x, "DOP853", times, rtol=1e-13, atol=1e-13).y.T
    errors = []
    for h in (step, step / 2, step / 4):
        (path,) = (m := model(step=h)).trajectories(state(m, x)[None], times)
        errors.append(np.max(np.abs(path.states[:, : len(x)] - exact)))
    assert errors[2] < 1e-6 * np.max(np.abs(exact))
    assert np.log2(errors[0] / errors[1]) == pytest.approx(4, abs=0.4)
    assert np.log2(errors[1] / errors[2]) == pytest.approx(4, abs=0.4)


def test_derivatives_are_those_of_the_variational_equations():
    """Lorenz-63 by scipy: the path, and how it changes with the start in x and with ρ."""

    def slope(t, v):
        (x, y, z), changes = v[:3], v[3:].reshape(2, 3).T
        jacobian = np.array([[-10, 10, 0], [28 - z, -1, -x], [y, x, -8 / 3]])
        of_rho = np.outer([0, x, 0], [0, 1])
        return np.concatenate([lorenz63_by_hand(t, v[:3]), (jacobian @ changes + of_rho).T.ravel()])

    times, x = np.array([0.3, 1.0]), np.array([1.5, -1.5, 25.0])
    start = np.concatenate([x, [1, 0, 0], [0, 0, 0]])
    exact = solve_ivp(slope, (0, 1), start, "DOP853", times, rtol=1e-13, atol=1e-13).y.T
    model = lorenz63(step=0.0005)
    path, changes = model.tangent(state(model, x), np.eye(6)[[0, 4]], times)
    np.testing.assert_allclose(path.states[:, :3], exact[:, :3], rtol=1e-8)
    np.testing.assert_allclose(changes[..., :3], exact[:, 3:].reshape(2, 2, 3).swapaxes(0, 1), rtol=1e-7, atol=1e-9)


def test_lorenz63_fixed_points_symmetry_and_contraction():
    model = lorenz63()
    r = np.sqrt(8 / 3 * 27)
    for point in ([0, 0, 0], [r, r, 27], [-r, -r, 27]):
        assert model.step(state(model, point), 0.0, 0.25)[:3] == pytest.approx(point, abs=1e-10)
    x, mirror = np.array([1.0, 2.0, 20.0]), np.array([-1, -1, 1])
    moved = model.step(state(model, x), 0.0, 0.5)[:3]
    assert model.step(state(model, mirror * x), 0.0, 0.5)[:3] == pytest.approx(mirror * moved, rel=1e-12)
    # the volume of the state space contracts at the rate σ + 1 + β everywhere
    fine, h, t = lorenz63(step=0.001), 1e-6, 0.05
    columns = [
        (fine.step(state(fine, x + h * e), 0.0, t) - fine.step(state(fine, x - h * e), 0.0, t))[:3] / (2 * h)
        for e in np.eye(3)
    ]
    assert np.log(np.linalg.det(columns)) == pytest.approx(-(10 + 1 + 8 / 3) * t, rel=1e-6)


def test_lorenz96_equilibrium_rotation_and_energy():
    model = lorenz96(step=0.005)
    assert model.step(state(model, np.full(40, 8.0)), 0.0, 0.2)[:40] == pytest.approx(np.full(40, 8.0), abs=1e-12)
    x = 3 * RNG(1).standard_normal(40)
    moved = model.step(state(model, x), 0.0, 0.2)[:40]
    assert model.step(state(model, np.roll(x, 5)), 0.0, 0.2)[:40] == pytest.approx(np.roll(moved, 5), abs=1e-11)
    # advection conserves energy: d/dt ½|x|² = −|x|² + F Σx, so without forcing |x|² decays as exp(−2t)
    calm = state(model, x)
    calm[40] = 0.0
    energy = np.sum(model.step(calm, 0.0, 0.2)[:40] ** 2)
    assert energy == pytest.approx(np.exp(-0.4) * np.sum(x**2), rel=1e-7)


def test_linear_closed_form():
    model = linear(oscillators=3)
    x = RNG(2).standard_normal(6)
    (path,) = model.trajectories(state(model, x)[None], np.array([0.7, 2.0]))
    z = x[0::2] + 1j * x[1::2]
    for t, at in zip(path.times, path.states, strict=True):
        expected = z * np.exp((1j * np.array([1, 2, 3]) - 0.3) * t)
        assert at[0:6:2] + 1j * at[1:6:2] == pytest.approx(expected, abs=1e-14)
    twice = model.step(model.step(state(model, x), 0.0, 0.7), 0.7, 2.0)
    assert twice == pytest.approx(path.states[1], abs=1e-14)


@pytest.mark.parametrize("name", MODELS)
def test_batches_of_members_and_times(name):
    """Members do not see each other, times may be each member's own, and parameters ride along."""
    model = MODELS[name]
    x = model.initial_states({k: np.full(4, v) for k, v in THETA.items()})
    x[:, :2] += RNG(3).standard_normal((4, 2))
    times = np.array([[0.1, 0.4], [0.2, 0.4], [0.3, 0.5], [0.1, 0.4]])
    paths = model.trajectories(x, times)
    for i, path in enumerate(paths):
        (alone,) = model.trajectories(x[i : i + 1], times[i])
        assert np.array_equal(path.states, alone.states)
        constant = len(model.parameters)
        assert np.array_equal(path.states[:, -constant:], np.tile(x[i, -constant:], (2, 1)))
        by_step = model.step(x[i], 0.0, times[i, 0])
        assert np.array_equal(by_step, path.states[0])
    assert [f.name for f in model.layout][-1] == model.parameters[-1].name


def test_a_member_that_explodes_is_a_failure_of_that_member():
    model = lorenz96(size=7)
    x = np.tile(state(model), (3, 1))
    x[1, :7] = 1e200 * np.arange(7)
    outcomes = model.trajectories(x, np.array([0.05, 0.1]))
    assert isinstance(outcomes[1], Failure)
    assert outcomes[1] == Failure("non-finite state", 0.05)
    assert not any(isinstance(outcomes[i], Failure) for i in (0, 2))


def test_written_against_the_public_interface_in_few_lines():
    for path in Path(en4dvar_lorenz.__file__).parent.glob("*.py"):
        text = path.read_text(encoding="utf-8")
        assert len(text.splitlines()) < 80, path.name
        assert "from en4dvar." not in text or path.name == "rk4.py", path.name  # which compiles for all of them


@pytest.mark.slow
def test_compiled_code_is_kept_for_later_processes():
    """It is compiled here, or was before; then another process finds it."""
    code = "import numpy as np\n"
    for module, n in (("lorenz63", 6), ("lorenz96", 9), ("lotka_volterra", 6)):
        importlib.import_module(f"en4dvar_lorenz.{module}").integrate(np.ones((1, n)), np.array([[0.1]]), 0.1)
        code += f"from en4dvar_lorenz.{module} import integrate\nintegrate(np.ones((1, {n})), np.array([[0.1]]), 0.1)\n"
        code += "print(list(integrate.stats.cache_hits.values()), list(integrate.stats.cache_misses.values()))\n"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[1] []\n" * 3


def test_a_population_that_has_died_out_has_no_logarithm_and_no_warning():
    """On the terminal of a design stood "RuntimeWarning: divide by zero encountered in log"."""
    assert Logarithm("prey")({"prey": np.array([1.0, 0.0])}).tolist() == [0.0, -np.inf]
