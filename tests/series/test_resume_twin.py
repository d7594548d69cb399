"""A sequential run continues from any cycle to the same bits, and a killed twin experiment from its checkpoint."""

from __future__ import annotations

import random
import re
import shutil
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from run_files import kill_after_writes, resumed_until_done, run_cli
from twin_models import Ring

from en4dvar.config import load_twin
from en4dvar.model.forward import Failure
from en4dvar.plumbing.errors import OutputError
from en4dvar.results.checkpoint import decode, encode
from en4dvar.runs.cycles import run_twin
from en4dvar.runs.interrupt import Interrupted
from en4dvar.schemes.bootstrap_filter import BootstrapFilter
from en4dvar.schemes.filters import ESRF, ETKF, EnKF, OptimalInterpolation
from en4dvar.schemes.ienks import IEnKS
from en4dvar.series.model_error import ModelError
from en4dvar.series.moments import Moments, SequentialState
from en4dvar.series.sequential import SequentialSettings, run_sequential
from en4dvar.series.series import CycleSeries
from en4dvar.series.settings import EnKS, EnRTS, Inflation

YAML = """\
name: ring
seed: 4
model: {name: "twin_models:Ring"}
twin:
  cycles: 60
  burn_in: 10
  interval: 0.5
  error: {x_std: 0.5}
  initial_std: {x: 0.3, v: 0.3}
assimilation: {scheme: ienks, lag: 2, members: 8, inflation: 1.02, rotation: true}
execution: {checkpoint_every: 0}
output: {report: false}
"""


class Losing(Ring):
    """Two members are lost on the way."""

    def trajectories(self, x, times):
        batch = super().trajectories(x, times)
        return [Failure("too far") if abs(path.states[-1, 0]) > 1.5 else path for path in batch]


def assert_same(a, b):
    for field in fields(a):
        left, right = getattr(a, field.name), getattr(b, field.name)
        if isinstance(left, Moments):
            assert_same(left, right)
        elif field.name == "kept":
            assert repr(left) == repr(right)
            assert all(np.array_equal(a, b) for (_, a), (_, b) in zip(left, right, strict=True))
        elif isinstance(left, np.ndarray):
            assert np.array_equal(left, right, equal_nan=True), field.name
        else:
            assert left == right, field.name


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scheme", "smoother", "error"),
    [
        (ETKF(), None, None), (IEnKS(1), None, None), (IEnKS(3), None, None), (IEnKS(2, "bundle"), None, None),
        (EnKF(), EnKS(3), None), (ESRF(), EnRTS(), None), (ETKF(), EnKS(3), "drawn"), (ETKF(), EnRTS(), "drawn"),
        (ETKF(), EnRTS(), "square-root"), (BootstrapFilter(0.5), None, None), (OptimalInterpolation(), None, None),
    ],
)  # fmt: skip
@pytest.mark.parametrize("model", [Ring(), Losing()])
def test_resumed_from_any_cycle(scheme, smoother, error, model):
    rng = np.random.default_rng(0)
    members = model.initial_state({}) + 0.8 * rng.standard_normal((14, 12))
    series = CycleSeries(0.5 * np.arange(1, 12), rng.standard_normal((11, 6)), np.full(6, 0.7))
    truth = rng.standard_normal((11, 12))
    settings = SequentialSettings(
        scheme, Inflation(1.02, rtps=0.3), rotation=True, min_active_fraction=0.1, smoother=smoother,
        model_error=ModelError(np.full(12, 0.01), error) if error else None,
    )  # fmt: skip

    def run(resume=None):
        states = []
        result = run_sequential(
            model, model.observables, members, series, settings, 3, resume=resume,
            keep=lambda now: states.append(now()), truth=truth,
        )  # fmt: skip
        return result, states

    whole, states = run()
    assert [state.cycle for state in states] == list(range(1, 12))
    assert bool(whole.failures) == isinstance(model, Losing)
    for state in states:
        again, rest = run(decode(encode(state), SequentialState))
        assert_same(again, whole)
        assert len(rest) == 11 - state.cycle


def write(folder: Path, *changes: tuple[str, str]) -> Path:
    text = YAML
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    (folder / "ring.yaml").write_text(text)
    return folder / "ring.yaml"


def result_of(directory: Path) -> dict[str, np.ndarray]:
    import xarray as xr

    with xr.open_dataset(directory / "twin.nc") as data:
        return {str(name): variable.values for name, variable in data.variables.items()}


def assert_same_files(a: Path, b: Path) -> None:
    left, right = result_of(a), result_of(b)
    assert left.keys() == right.keys()
    for name, values in left.items():
        same = values.tobytes() == right[name].tobytes() if values.dtype != object else (values == right[name]).all()
        assert same, name
    assert (a / "summary.csv").read_bytes() == (b / "summary.csv").read_bytes()


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    """A quiet run, and one that was interrupted at half of its forecasts."""
    folder = tmp_path_factory.mktemp("twin")
    path, out = write(folder), folder / "run"
    Ring.calls = Ring.stop_at = 0
    run_twin(path, overrides={"output.directory": str(folder / "quiet")})
    Ring.calls, Ring.stop_at = 0, Ring.calls // 2
    with pytest.raises(Interrupted, match=re.escape(f"are kept in {out}")):
        run_twin(path, overrides={"output.directory": str(out)})
    Ring.calls = Ring.stop_at = 0
    return folder


@pytest.fixture
def interrupted(original, tmp_path):
    shutil.copytree(original / "run", tmp_path / "run")
    return write(tmp_path), tmp_path / "run", original / "quiet"


def test_interrupted_and_resumed(interrupted):
    path, out, quiet = interrupted
    seen = []
    run_twin(path, overrides={"output.directory": str(out)}, resume=True, on_cycle=seen.append)
    assert 20 < seen[0] < 40
    assert seen[-1] == 59
    assert_same_files(out, quiet)
    assert f"continued after {seen[0]} of 60 cycles" in (out / "run.log").read_text()
    seen.clear()
    run_twin(path, overrides={"output.directory": str(out)}, resume=True, on_cycle=seen.append)
    assert seen == []  # nothing is conducted twice
    assert_same_files(out, quiet)


@pytest.mark.parametrize(
    ("old", "new", "difference"),
    [
        ("seed: 4", "seed: 5", r"-seed: 4\n\+seed: 5"),
        ("cycles: 60", "cycles: 61", r"-  cycles: 60\n\+  cycles: 61"),
        ("inflation: 1.02", "inflation: 1.03", r"-  inflation: 1\.02\n\+  inflation: 1\.03"),
    ],
)
def test_a_changed_experiment_is_refused_with_the_difference(interrupted, old, new, difference):
    path, out, _ = interrupted
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(OutputError, match="cannot be resumed to the same result") as refused:
        run_twin(path, overrides={"output.directory": str(out)}, resume=True)
    assert re.search(difference, str(refused.value))


def test_a_damaged_checkpoint_is_named_and_not_used(interrupted):
    path, out, quiet = interrupted
    file = out / "checkpoints" / "twin.cycle"
    file.write_bytes(file.read_bytes()[:-1])
    run_twin(path, overrides={"output.directory": str(out)}, resume=True)
    assert "twin.cycle: damaged or incomplete" in (out / "run.log").read_text()
    assert_same_files(out, quiet)


@pytest.mark.slow
def test_workers_and_report_may_change(interrupted):
    path, out, quiet = interrupted
    run_twin(
        load_twin(path, {"output.directory": str(out), "output.report": True, "output.figures": True}), resume=True
    )
    assert_same_files(out, quiet)
    assert "spread / RMSE" in (out / "report.html").read_text()
    names = {p.name for p in (out / "figures").iterdir()}
    assert names == {
        f"{n}.{end}" for n in ("errors", "ranks", "reliability", "scores", "truth_ranks") for end in ("pdf", "png")
    }


def kill_and_resume(tmp_path: Path, kills: int, seed: int) -> None:
    path, pause = write(tmp_path), {"EN4DVAR_TEST_PAUSE": 0.003}
    quiet = run_cli("run", path, "--out", tmp_path / "quiet")
    assert quiet.returncode == 0, quiet.stderr
    draw, done, finished = random.Random(seed), 0, 0
    while done < kills or finished == 0:
        out = tmp_path / f"run{finished}"

        def attempt(resume: tuple[str, ...], out: Path = out) -> tuple[int, str]:
            writes, wait = draw.randint(1, 30), draw.uniform(0, 0.03)
            file = out / "checkpoints" / "twin.cycle"
            return kill_after_writes(file, writes, wait, "run", path, "--out", out, *resume, **pause)

        done += resumed_until_done(attempt)
        assert_same_files(out, tmp_path / "quiet")
        finished += 1


@pytest.mark.slow  # the states of every cycle are resumed above
def test_killed_and_resumed(tmp_path):
    """SIGKILL at a random moment of the cycles."""
    kill_and_resume(tmp_path, 1, 1)


@pytest.mark.slow
@pytest.mark.long
def test_killed_at_20_random_moments(tmp_path):
    kill_and_resume(tmp_path, 20, 2)
