"""The sweep: NRMSE as defined, the design, streaming, continuing, and what is refused."""

from __future__ import annotations

import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from en4dvar.assembly.build import build
from en4dvar.cli import main
from en4dvar.config import load_config
from en4dvar.data.noise import noise_of
from en4dvar.data.observations import Observations
from en4dvar.data.series import Part
from en4dvar.executor import ThreadsExecutor
from en4dvar.model.state import NOISE_SCALE
from en4dvar.plumbing.errors import ConfigError, DataError
from en4dvar.priors.prior import PriorTerm
from en4dvar.sampling.sweep import SweepResult, SweepSettings, best_over_shifts, run_sweep, sobol_box, targets
from en4dvar_agarose.run import one_model

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
SMALL = SweepSettings(trajectories=192, shift=0.8e-6, step=0.1e-6, chunk=64)


def readings(times, values, name="a"):
    ones = np.ones(len(times))
    return Observations(np.asarray(times), np.asarray(values), noise_of(ones), ones, name=name)


@pytest.fixture(scope="module")
def problems():
    return build(load_config(CONFIGS / "agarose_03_qlkv.yaml"))[:3]


@pytest.fixture(scope="module")
def whole(problems):
    return run_sweep(problems, SMALL, seed=1)


def test_nrmse_by_its_definition():
    """Against the formula, written out: nearest grid instant of t + shift, every shift tried."""
    rng = np.random.default_rng(0)
    sets = [readings(np.sort(rng.uniform(5, 30, k)), rng.uniform(10, 100, k)) for k in (7, 12)]
    aims = targets(sets, shift=0.8, step=0.05)
    traces = 50 + 40 * np.sin(aims.grid / 5 + rng.uniform(0, 6, (4, 1)))
    nrmse, shift = best_over_shifts(traces, aims)
    assert aims.reach == 16
    for b in range(4):
        for s, o in enumerate(sets):
            best = -np.inf
            for k in range(-16, 17):
                # the nearest grid instant of the reading, then the shift in whole steps
                nearest = [int(np.argmin(np.abs(aims.grid - t))) + k for t in o.times]
                error = np.linalg.norm(o.values - traces[b, nearest])
                best = max(best, 1 - error / np.linalg.norm(o.values - o.values.mean()))
            assert nrmse[b, s] == pytest.approx(best, abs=1e-12)
            assert abs(shift[b, s]) <= 0.8 + 1e-12


def test_a_trace_through_the_shifted_readings_is_a_perfect_fit():
    o = readings(np.arange(5.0, 25.0, 1.5), 10 + np.arange(14.0) ** 2)
    aims = targets([o], shift=0.8, step=0.1)
    trace = np.interp(aims.grid - 0.5, o.times, o.values)  # told at t, taken at t + 0.5
    nrmse, shift = best_over_shifts(trace[None], aims)
    assert nrmse[0, 0] == pytest.approx(1, abs=1e-9)
    assert shift[0, 0] == pytest.approx(0.5)


def test_a_reading_of_weight_zero_or_a_bound_is_none():
    o = readings(np.arange(5.0, 25.0, 1.5), 10 + np.arange(14.0) ** 2)
    odd = replace(o, values=np.where(np.arange(14) == 6, 1e3, o.values), weights=1.0 * (np.arange(14) != 6))
    bound = replace(odd, noise=noise_of(np.ones(14), sides=1.0 * (np.arange(14) == 6)), weights=np.ones(14))
    some = readings(np.delete(o.times, 6), np.delete(o.values, 6))
    trace = 8 + np.arange(14.0) ** 2
    expected, aims = targets([some], shift=0.0, step=1.5), targets([odd, bound], shift=0.0, step=1.5)
    assert aims.grid == pytest.approx(expected.grid)
    (found,), ((alone,),) = (best_over_shifts(trace[None], of)[0] for of in (aims, expected))
    assert found == pytest.approx([alone, alone])
    for alike in (replace(o, values=np.ones(14)), replace(odd, weights=np.zeros(14))):
        with pytest.raises(ValueError, match="a: a fit by NRMSE needs readings"):
            targets([o, alike], shift=0.0, step=1.5)


def test_a_constant_at_the_mean_has_nrmse_zero_and_a_lost_trace_none():
    o = readings(np.arange(5.0, 25.0, 1.5), 10 + np.arange(14.0) ** 2)
    aims = targets([o], shift=0.0, step=0.1)
    flat = np.full((2, len(aims.grid)), o.values.mean())
    flat[1, 3] = np.nan
    nrmse, _ = best_over_shifts(flat, aims)
    assert nrmse[0, 0] == pytest.approx(0, abs=1e-12)
    assert nrmse[1, 0] == -np.inf


def test_sobol_box_grows_without_moving_and_fills_the_box():
    centre, half = np.array([1.0, -3.0]), np.array([0.5, 2.0])
    few, many = sobol_box(centre, half, 100, 7), sobol_box(centre, half, 1000, 7)
    np.testing.assert_array_equal(few, many[:100])
    assert np.all(np.abs(many - centre) <= half)
    np.testing.assert_allclose(many.mean(axis=0), centre, atol=0.02)


def test_bits_do_not_depend_on_workers_or_chunks(problems, whole):
    with ThreadsExecutor(2) as executor:
        other = run_sweep(problems, replace(SMALL, chunk=50), 1, executor)
    np.testing.assert_array_equal(other.theta, whole.theta)
    np.testing.assert_array_equal(other.nrmse, whole.nrmse)


def test_an_interrupted_sweep_continues_with_the_missing_chunks(problems, whole, tmp_path):
    class Stop(Exception):
        pass

    def interrupt(done, total):
        if done >= 128:
            raise Stop

    with pytest.raises(Stop):
        run_sweep(problems, SMALL, seed=1, folder=tmp_path, progress=interrupt)
    kept = sorted(tmp_path.glob("*.npz"))
    assert kept
    stamps = {file: file.stat().st_mtime_ns for file in kept}
    again = run_sweep(problems, SMALL, seed=1, folder=tmp_path)
    np.testing.assert_array_equal(again.theta, whole.theta)
    np.testing.assert_array_equal(again.shift, whole.shift)
    assert all(file.stat().st_mtime_ns == stamp for file, stamp in stamps.items())
    assert len(list(tmp_path.glob("*.npz"))) == 3


def test_refinement_never_worsens_and_finds_better(problems, whole):
    refined = run_sweep(problems, replace(SMALL, rounds=2, local=32), seed=1)
    assert np.all(refined.nrmse >= whole.nrmse)
    assert np.any(refined.nrmse > whole.nrmse)
    assert refined.trajectories == 192 + 3 * 32 * 3


def test_parameters_of_the_errors_are_not_searched(problems, whole):
    """NRMSE knows no errors: a scale of theirs would be told as if the readings said something of it."""
    scaled = [
        replace(problem, prior=problem.prior.of((*problem.prior.terms, PriorTerm.lognormal(NOISE_SCALE, 1.0, 0.4))))
        for problem in problems
    ]
    again = run_sweep(scaled, SMALL, seed=1)
    assert again.parameters == whole.parameters
    np.testing.assert_array_equal(again.theta, whole.theta)
    with pytest.raises(ConfigError, match="nothing but a time shift and errors"):
        run_sweep([replace(p, prior=p.prior.of(p.prior.terms[-1:])) for p in scaled], SMALL, seed=1)


def test_a_data_set_of_several_series_is_refused(problems):
    """All of them would be compared with the first observable."""
    one = problems[0]
    part = Part("R", one.observable, 0, len(one.observations))
    with pytest.raises(ConfigError, match="a sweep fits data sets of one series"):
        run_sweep([replace(one, observations=replace(one.observations, parts=(part,)))], SMALL, seed=1)


def test_weighted_moments(whole):
    w = whole.nrmse / whole.nrmse.sum()
    mean = w @ whole.theta
    np.testing.assert_allclose(whole.mean, mean)
    np.testing.assert_allclose(whole.std, np.sqrt(w @ (whole.theta - mean) ** 2))


def test_the_design_is_shared(problems):
    other = replace(problems[1], fixed={"G": 1.0})
    with pytest.raises(ConfigError, match="the design is shared"):
        run_sweep([problems[0], other], SMALL, seed=1)


def test_one_design_serves_two_gels_and_each_keeps_to_its_own_range(problems):
    stiff = build(load_config(CONFIGS / "agarose_10_qlkv.yaml"))[:2]
    calls = []
    result = run_sweep(
        one_model([*problems, *stiff]), replace(SMALL, rounds=1), seed=1, progress=lambda done, _: calls.append(done)
    )
    assert calls[-1] == result.trajectories == 192 + 2 * 32 * 5  # once, not once a gel
    kept = [j for j, name in enumerate(problems[0].prior.names) if name != "t_s"]
    for sets, part in ((problems, result.part(slice(0, 3))), (stiff, result.part(slice(3, 5)))):
        prior = sets[0].prior
        assert part.names == tuple(p.observations.name for p in sets)
        z = (np.log(part.theta) - prior.mean[kept]) / prior.std[kept]
        assert np.all(np.abs(z) <= SMALL.width + 1e-6)
    soft, hard = result.theta[:3, 0], result.theta[3:, 0]
    assert soft.max() < 1300 < 2800 < hard.min()  # their ranges of G do not meet: 0.5 and 7 kPa, a factor 2.46 each way


DIES_AFTER_THREE_CHUNKS = """
import itertools, os, signal
from en4dvar.cli import main
replace, chunks = os.replace, itertools.count(1)
def dies(source, target, **places):
    replace(source, target, **places)
    if str(target).endswith(".npz") and "checkpoints" in str(target) and next(chunks) == 3:
        os.kill(os.getpid(), signal.SIGKILL)
os.replace = dies
main()
"""


@pytest.mark.slow
@pytest.mark.fault("kill-commands")
def test_a_killed_sweep_is_resumed_to_the_same_numbers(tmp_path):
    words = ["sweep", str(CONFIGS / "agarose_03_nh.yaml"), "--trajectories", "16384", "--out"]  # eight chunks
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    assert CliRunner().invoke(main, [*words, str(whole)]).exit_code == 0
    process = subprocess.run([sys.executable, "-c", DIES_AFTER_THREE_CHUNKS, *words, str(killed)], capture_output=True)
    assert process.returncode == -signal.SIGKILL
    assert 3 <= len(list(killed.glob("checkpoints/sweep/*.npz"))) < 8  # another thread may end one while it dies
    assert CliRunner().invoke(main, [*words, str(killed), "--resume"]).exit_code == 0
    assert (killed / "sweep.csv").read_bytes() == (whole / "sweep.csv").read_bytes()


def test_readings_before_the_start_are_refused(problems):
    with pytest.raises(DataError, match="before the start"):
        run_sweep(problems, replace(SMALL, shift=6e-6), seed=1)


def test_a_step_far_below_the_times_of_the_readings_is_refused_before_memory_is_taken(problems):
    """Those of the command are meant for bubbles; the readings here are of a minute."""
    slow = replace(problems[0], observations=readings(np.arange(61.0), np.arange(61.0) ** 2))
    with pytest.raises(DataError, match=r"2\.4e\+09 instants.* readings are 1 apart, give a larger --step"):
        run_sweep([slow], SweepSettings(64, 0.8e-6, 0.025e-6), seed=1)


@pytest.mark.parametrize(
    ("fits", "mean", "std"),
    [([0.9, 0.3], 2.5, np.sqrt(0.75)), ([0.9, -0.4], 2.0, 0.0), ([0.9, -0.9], 2.0, 0.0), ([-0.4, -0.2], 3.0, 1.0)],
)
def test_a_set_that_is_fitted_worse_than_by_a_constant_does_not_count(fits, mean, std):
    theta = np.array([[2.0], [4.0]])
    result = SweepResult(("a", "b"), (), theta, np.zeros(2), np.array(fits), 1)
    assert result.mean == pytest.approx([mean])
    assert result.std == pytest.approx([std])
