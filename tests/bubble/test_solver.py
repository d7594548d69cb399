"""The integrator: its coefficients, its arithmetic, its independence of batching, its failures."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from pathlib import Path

import numba as nb
import numpy as np
import pytest
from scipy.integrate import quad

import en4dvar_bubble.solver
from en4dvar.model.forward import Failure
from en4dvar.plumbing.compiled import _digest
from en4dvar_bubble import Accuracy, BubbleModel, get_law, simulate
from en4dvar_bubble.solver import integrate, lanes, rodas5p
from en4dvar_bubble.solver.collocation import ball

TIMES = np.linspace(4e-6, 80e-6, 60)


def gels(n, seed=0):
    rng = np.random.default_rng(seed)
    centre = {"G": 6900.0, "alpha": 0.025, "mu": 0.15, "R0": 1.3e-6}
    return {k: v * np.exp(0.3 * rng.standard_normal(n)) for k, v in centre.items()}


def rosenbrock(f, jac, f_t, y, t, h):
    """One step in plain NumPy; returns the new state and the stages."""
    k = np.zeros((rodas5p.STAGES, len(y)))
    M = np.eye(len(y)) / (h * rodas5p.GAMMA) - jac(t, y)
    for i in range(rodas5p.STAGES):
        right = f(t + rodas5p.ALPHA[i] * h, y + rodas5p.A[i] @ k) + rodas5p.C[i] @ k / h
        k[i] = np.linalg.solve(M, right + h * rodas5p.D[i] * f_t(t, y))
    return y + rodas5p.B @ k, k


class TestRodas5P:
    """A nonlinear, non-autonomous problem with a known solution: y' = −y² cos t, y = 1/(2 + sin t)."""

    @staticmethod
    def solve(steps, inside=None):
        def f(t, y):
            return -(y**2) * np.cos(t)

        h = 2.0 / steps
        y, t = np.array([0.5]), 0.0
        for _ in range(steps):
            new, k = rosenbrock(f, lambda t, y: np.diag(-2 * y * np.cos(t)), lambda t, y: y**2 * np.sin(t), y, t, h)
            if inside is not None:
                K = rodas5p.H @ k
                s = inside
                dense = (1 - s) * y + s * (new + (1 - s) * (K[0] + s * (K[1] + s * K[2])))
                yield t + s * h, dense[0], k[-1][0]
            y, t = new, t + h
        yield t, y[0], k[-1][0]

    @staticmethod
    def error(steps):
        t, y, _ = list(TestRodas5P.solve(steps))[-1]
        return abs(y - 1 / (2 + np.sin(t)))

    def test_order_five(self):
        order = np.log2(self.error(8) / self.error(16))
        assert order == pytest.approx(rodas5p.ORDER, abs=0.4)
        assert np.log2(self.error(16) / self.error(32)) == pytest.approx(rodas5p.ORDER, abs=0.25)

    def test_dense_output_of_order_four(self):
        def largest(steps):
            return max(abs(y - 1 / (2 + np.sin(t))) for t, y, _ in list(self.solve(steps, 0.37))[:-1])

        assert np.log2(largest(32) / largest(64)) > 3.8

    def test_stiffly_accurate(self):
        """On y' = λ(y − g) + g′ with λ → −∞ one step lands on g."""
        lam = -1e8
        new, _ = rosenbrock(
            lambda t, y: lam * (y - np.sin(t)) + np.cos(t),
            lambda t, y: np.array([[lam]]),
            lambda t, y: np.array([-lam * np.cos(t) - np.sin(t)]),
            np.array([0.0]),
            0.0,
            0.1,
        )
        assert new[0] == pytest.approx(np.sin(0.1), abs=1e-7)


class TestLanes:
    def test_exponential_to_one_ulp(self):
        @nb.njit
        def run(x, out):
            for row in range(x.shape[0]):
                lanes.store(out, row, lanes.exp(lanes.load(x, row)))

        x = np.random.default_rng(0).uniform(-50, 50, (500, lanes.WIDTH))
        out = np.empty_like(x)
        run(x, out)
        assert np.max(np.abs(out / np.exp(x) - 1)) < 5e-16

    def test_select_min_max_floor(self):
        @nb.njit
        def run(x, out):
            a = lanes.load(x, 0)
            lanes.store(out, 0, lanes.select(a > 0.5, a * 2.0, -a))
            lanes.store(out, 1, lanes.minimum(lanes.maximum(a, -1.0), 1.0))
            lanes.store(out, 2, lanes.floor(a))

        x = np.linspace(-3, 3, lanes.WIDTH)[None].copy()
        out = np.empty((3, lanes.WIDTH))
        run(x, out)
        np.testing.assert_array_equal(out, [np.where(x > 0.5, 2 * x, -x)[0], np.clip(x, -1, 1)[0], np.floor(x)[0]])


class TestCollocation:
    @pytest.mark.parametrize("m", [1, 4, 9])
    def test_exact_on_even_polynomials(self, m):
        b = ball(m)
        for degree in range(0, 2 * m + 1, 2):
            f = b.x**degree
            np.testing.assert_allclose(b.derivative @ f, degree * b.x ** max(degree - 1, 0) * (degree > 0), atol=1e-9)
            expected = degree * (degree + 1) * b.x ** max(degree - 2, 0)
            np.testing.assert_allclose(b.laplacian @ f, expected, atol=1e-7)
            assert b.weights @ f == pytest.approx(3 / (degree + 3), rel=1e-12)

    @pytest.mark.parametrize("m", [1, 4, 9])
    def test_clustered_nodes_are_exact_on_polynomials_in_their_map(self, m):
        c = 3.0
        b = ball(m, c)

        def xi(y):
            return 1 - np.arcsinh((1 - y**2) * np.sinh(c)) / c

        slope = 2 * b.x * np.sinh(c) / (c * np.hypot(1, (1 - b.x**2) * np.sinh(c)))
        for degree in range(m + 1):
            expected = degree * xi(b.x) ** max(degree - 1, 0) * slope
            np.testing.assert_allclose(b.derivative @ xi(b.x) ** degree, expected, atol=1e-9)
            mean, _ = quad(lambda y, k=degree: 3 * y**2 * xi(y) ** k, 0, 1, epsabs=1e-13)
            assert b.weights @ xi(b.x) ** degree == pytest.approx(mean, rel=1e-11)

    def test_clustered_nodes_converge_on_even_polynomials_and_lie_nearer_the_wall(self):
        coarse, fine = ball(12, 3.0), ball(24, 3.0)
        assert 1 - coarse.x[-2] < 0.4 * (1 - ball(12).x[-2])
        errors = [np.abs(b.laplacian @ b.x**4 - 20 * b.x**2).max() for b in (coarse, fine)]
        assert errors[1] < 1e-3 * errors[0]


class TestBatching:
    def test_members_do_not_influence_each_other(self):
        together = simulate(parameters=gels(19), times=TIMES).R.values
        for i in (0, 7, 18):
            alone = {k: v[i] for k, v in gels(19).items()}
            np.testing.assert_array_equal(simulate(parameters=alone, times=TIMES).R.values[0], together[i])

    def test_same_bits_for_any_number_of_workers(self):
        one = simulate(parameters=gels(150), times=TIMES)
        np.testing.assert_array_equal(one.R, simulate(parameters=gels(150), times=TIMES, workers=2).R)
        assert (one.status == 0).all()

    def test_output_times_do_not_change_the_path(self):
        few = simulate(parameters=gels(3), times=TIMES[::7]).R
        np.testing.assert_array_equal(few, simulate(parameters=gels(3), times=TIMES).R[:, ::7])

    @pytest.mark.slow
    def test_restart_from_any_state_agrees_with_the_continuous_path(self):
        model = BubbleModel(accuracy=Accuracy(nodes=8, rtol=1e-8))
        x = model.initial_state({k: v[0] for k, v in gels(1).items()})
        times = np.array([5.2e-6, 9e-6, 20e-6, 24e-6])
        path = model.trajectories(x[None], times)[0]
        t = 0.0
        for k, t_next in enumerate(times):
            x = model.step(x, t, t_next)
            np.testing.assert_allclose(x, path.states[k], rtol=3e-5)
            t = t_next


CRAWL = """
import time
import numpy as np
from en4dvar_bubble import Accuracy, simulate
gel = {"G": 6900.0, "alpha": 0.025, "mu": 0.15, "R0": 1.3e-6}
accuracy, times = Accuracy(rtol=1e-17, step_limit=10**9, time_limit=8.0), np.linspace(6e-6, 2e-3, 60)
simulate(parameters=gel, times=times[:1], accuracy=Accuracy())
print("begins", flush=True)
begun = time.process_time()
data = simulate(parameters=gel, times=times, accuracy=accuracy)
print(time.process_time() - begun, data.reason.values[0])
"""


class TestFailures:
    def test_step_limit_is_a_reason_not_an_exception(self):
        model = BubbleModel(accuracy=Accuracy(step_limit=150))
        theta = gels(3)
        x = model.initial_states(theta)
        results = model.trajectories(x, TIMES)
        assert all(isinstance(r, Failure) and r.reason.startswith("step limit reached at t =") for r in results)

    def test_time_limit_ends_a_member_that_crawls(self):
        """A tolerance that needs millions of steps: without the limit this would take minutes."""
        crawl = Accuracy(rtol=1e-17, step_limit=10**9, time_limit=0.5)
        data = simulate(parameters=gels(1), times=TIMES, accuracy=crawl)
        assert data.reason.values[0].startswith("time limit reached at t =")

    @pytest.mark.slow
    @pytest.mark.skipif(not hasattr(signal, "SIGSTOP"), reason="a system without it")
    def test_a_member_may_take_its_time_though_the_process_was_suspended(self):
        """It crawls for 8 s. Were 10 s of sleep counted, it would end when woken, after half a second's work."""
        command = [sys.executable, "-c", CRAWL]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert process.stdout.readline() == "begins\n"
        time.sleep(0.5)
        process.send_signal(signal.SIGSTOP)
        time.sleep(10)
        process.send_signal(signal.SIGCONT)
        seconds, reason = process.communicate()[0].split(maxsplit=1)
        assert reason.startswith("time limit reached at t =")
        assert float(seconds) > 1

    def test_mach_limit_names_the_mach_number_and_spares_the_others(self):
        violent = {"G": [420.0, 2e4], "alpha": [0.0, 0.03], "mu": [0.02, 0.3], "R0": [0.43e-6, 3e-6]}
        data = simulate(parameters=violent, times=TIMES, accuracy=Accuracy(mach_limit=2.0))
        assert data.reason.values[0].startswith("model validity: wall Mach")
        assert data.reason.values[1] == ""
        assert np.isnan(data.R[0]).all()
        assert np.isfinite(data.R[1]).all()
        assert data.max_wall_mach[1] < 2


class TestCache:
    def test_compiled_kernels_are_stamped_with_all_their_sources(self, tmp_path):
        folder = Path(en4dvar_bubble.solver.__file__).parent
        assert integrate.integrate._cache._cache_file._source_stamp == _digest(folder, folder.parent / "tables.py")
        (tmp_path / "a.py").write_text("x = 1")
        before = _digest(tmp_path)
        (tmp_path / "a.py").write_text("x = 2")
        assert _digest(tmp_path) != before

    def test_nothing_compiles_at_import(self):
        code = "import en4dvar_bubble.solver.integrate as i; print(len(i.integrate.signatures))"
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
        assert done.stdout.strip() == "0"


class TestBounce:
    @pytest.mark.slow  # a viscosity that depends on the shear rate is compiled by itself, for a quarter of a minute
    @pytest.mark.parametrize("law", ["carreau", "cross"])
    def test_shear_thinning_bubble_passes_its_bounce(self, law):
        """The wall turns in 1e-12 µs, below the spacing of doubles near t, and the viscosity has its knee there."""
        t = np.linspace(5e-6, 80e-6, 40)
        values = {k: float(v[0]) for k, v in get_law(law).example_values().items()}
        data = simulate(law, {**values, "R0": [0.5e-6, 1e-6, 2e-6]}, t)
        assert (data.status == 0).all()
        assert float(data.max_wall_mach.max()) > 5
