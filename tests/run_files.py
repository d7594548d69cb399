"""Run directories of the toy oscillator, and equality of what they hold to the last bit."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from execution_models import Stops
from toy_config import csv_text, write_toy

from en4dvar.config import Config, load_config
from en4dvar.report.result import Result, load_result
from en4dvar.results.checkpoint import digest
from en4dvar.results.pack import PACK, Pack, packed, results_of
from en4dvar.runs.interrupt import Interrupted
from en4dvar.runs.runner import run_campaign

TESTS = Path(__file__).parent


def make_campaign(folder: Path, n: int = 4, model: str = "toy_models:Oscillator", large: int | None = None) -> Path:
    """A configuration with ``n`` data files in ``folder/data``; number ``large`` has twice the amplitude."""
    path = write_toy(
        folder,
        ("path: toy.csv", "path: data/*.csv"),
        ("toy_models:Oscillator", model),
    )
    (folder / "data").mkdir()
    for i in range(n):
        text = csv_text(k=1.6 + 0.15 * i)
        if i == large:
            head, *rows = text.splitlines()[1:]
            doubled = (f"{t},{2 * float(x):.6g}" for t, x in (row.split(",") for row in rows))
            text = "\n".join([head, *doubled, ""])
        (folder / "data" / f"set{i}.csv").write_text(text)
    return path


def configuration(path: Path, out: Path, **execution: object) -> Config:
    """The configuration with ``execution`` settings and run directory ``out``; every iteration is kept."""
    overrides = {"output.directory": str(out), "output.report": False, "execution.checkpoint_every": 0}
    return load_config(path, overrides | {f"execution.{key}": value for key, value in execution.items()})


def interrupt(path: Path, out: Path, call: int, resume: bool = False) -> str:
    """Run a configuration of ``execution_models:Stops`` until call number ``call`` of the model; the reason told."""
    Stops.calls, Stops.stop_at = 0, call
    with pytest.raises(Interrupted) as stopped:
        run_campaign(configuration(path, out), resume=resume)
    Stops.calls = Stops.stop_at = 0  # the next test counts from its own begin
    return str(stopped.value)


def trees(run: Path) -> dict[str, xr.DataTree]:
    """What is in every netCDF file and every result of a pack, by their names; read again where a file has changed."""
    files = [(path, path.stat()) for path in sorted([*run.rglob(PACK), *run.rglob("*.nc")])]
    return _trees(run, tuple((path, stat.st_ino, stat.st_mtime_ns, stat.st_size) for path, stat in files))


@lru_cache(maxsize=4)
def _trees(run: Path, state: object) -> dict[str, xr.DataTree]:
    packs = [address for pack in sorted(run.rglob(PACK)) for address in results_of(pack)]
    found = {p.relative_to(run).as_posix(): load_result(p).tree for p in packs}
    return found | {p.relative_to(run).as_posix(): xr.load_datatree(p) for p in sorted(run.rglob("*.nc"))}


def add_to_pack(run: Path, name: str, result: Result) -> Path:
    """Add a result to the pack of a run directory, which need not be one of a run; its address."""

    run.mkdir(parents=True, exist_ok=True)
    content = packed(result.groups)
    Pack(run / PACK).append(name, "", b"", content, digest(content))
    return run / PACK / name


def assert_same_results(a: Path, b: Path) -> None:
    """Every value of every group of every result agrees bit for bit; attributes of the making may differ."""
    left, right = trees(a), trees(b)
    assert left, f"no result in {a}"
    assert left.keys() == right.keys()
    for name in left:
        x, y = left[name], right[name]
        assert x.groups == y.groups
        for group in x.groups:
            one, two = x[group].to_dataset(inherit=False), y[group].to_dataset(inherit=False)
            assert set(one.variables) == set(two.variables), (name, group)
            for key in one.variables.keys() - {"data_source"}:
                u, v = one[key].values, two[key].values
                assert u.dtype == v.dtype
                assert u.tobytes() == v.tobytes() if u.dtype != object else np.array_equal(u, v), (name, group, key)
            if group != "/":
                assert stated(one) == stated(two), (name, group)


def stated(dataset: xr.Dataset) -> dict[str, str]:
    """Attributes but the path of the data."""
    return {str(k): str(v) for k, v in dataset.attrs.items() if k != "data_source"}


def command(*arguments: object) -> list[str]:
    return [sys.executable, "-m", "en4dvar.cli", *map(str, arguments)]


def environment(**variables: object) -> dict[str, str]:
    known = os.pathsep.join(p for p in (str(TESTS), os.environ.get("PYTHONPATH", "")) if p)
    return {**os.environ, "PYTHONPATH": known, **{k: str(v) for k, v in variables.items()}}


def run_cli(*arguments: object, **variables: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command(*arguments), capture_output=True, text=True, env=environment(**variables))


def _heed_ctrl_c() -> None:
    """A test run in the background of a shell has been told to ignore it, and its children inherit that."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def run_and_signal(
    number: signal.Signals, when: float | Path, *arguments: object, **variables: object
) -> tuple[int, str]:
    """Run, send a signal after some seconds, or once a file holds something; exit code and standard error."""
    process = subprocess.Popen(
        command(*arguments), stderr=subprocess.PIPE, text=True, env=environment(**variables), preexec_fn=_heed_ctrl_c
    )
    try:
        while isinstance(when, Path) and process.poll() is None and not (when.exists() and when.stat().st_size):
            time.sleep(0.01)
        _, told = process.communicate(timeout=0.0 if isinstance(when, Path) else when)
    except subprocess.TimeoutExpired:
        process.send_signal(number)
        _, told = process.communicate()
    return process.returncode, told


def kill_after_writes(file: Path, writes: int, wait: float, *arguments: object, **variables: object) -> tuple[int, str]:
    """Run, and SIGKILL ``wait`` seconds after ``file`` was written so many times; exit code (0: it had ended)."""
    process = subprocess.Popen(command(*arguments), stderr=subprocess.PIPE, text=True, env=environment(**variables))
    before = latest = _written(file)
    while process.poll() is None and writes:
        latest = _written(file)
        if latest not in (before, 0):
            before, writes = latest, writes - 1
        time.sleep(0.001)
    if process.poll() is None:
        time.sleep(wait)
        process.kill()
    _, told = process.communicate()
    return process.returncode, told


def _written(file: Path) -> int:
    try:
        return file.stat().st_mtime_ns
    except FileNotFoundError:
        return 0


def resumed_until_done(attempt: Callable[[tuple[str, ...]], tuple[int, str]]) -> int:
    """Make an attempt with no option, then with --resume after every kill, until one ends well: kills survived."""
    kills, resume = 0, ()
    while True:
        code, told = attempt(resume)
        assert code in (0, -signal.SIGKILL), told
        if code == 0:
            return kills
        kills, resume = kills + 1, ("--resume",)
