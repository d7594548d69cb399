"""Valid inputs to start from: what the project ships, and small files made here."""

from __future__ import annotations

import io
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import numpy as np

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
SERIES = b"t_us,R_um\n" + b"\n".join(b"%g,%g" % (5 + 1.5 * k, 40 + 3 * k - 0.2 * k * k) for k in range(12)) + b"\n"


FULL = """\
name: toy
seed: 3
data:
  path: toy.csv
  unsorted: sort
  repeated: average
  outliers: leave out
  columns:
    time: {name: t_us, unit: us, rate: 2 MHz}
    position: {name: R_um, unit: um}
  window: {from: 0 us, to: 140 us, prominence: 10 %}
  time_zero: 0 us
  error: {position_std: 2 um, time_std: 0.01 us, robust: huber, threshold: 1.5}
model: {name: "toy_models:Oscillator", mass: 2 g}
parameters:
  A: {prior: normal, mean: 100 um, std: 1 %}
  k: {prior: lognormal, median: 3 N/m, log_std: 0.3}
  c: {prior: logit, lower: 0 N s/m, upper: 1 N s/m, median: 0.02 N s/m, logit_std: 0.1}
  t_s: {prior: normal, mean: 0 us, std: 1 us}
  sigma: {prior: lognormal, mean: 1, std: 10 %}
initial_state: {v: {std: 0.1 m/s}}
assimilation: {members: 8, epsilon: 0.001, starts: 2, step_tolerance: 1.0e-3, min_active_fraction: 0.5}
execution: {executor: serial, workers: 1, checkpoint_every: 0.2}
output: {directory: runs/x, report: false}
simulate: {times: {from: 0 us, to: 100 us, step: 1 us}}
"""  # every section, every kind of prior, on SERIES


@cache
def of(target: str) -> tuple[bytes, ...]:
    """Inputs of a target that its reader accepts; the same each time, though some formats hold the time of day."""
    return tuple(_made(target))


def _made(target: str) -> Iterator[bytes]:
    match target:
        case "configuration":
            yield from (p.read_bytes() for p in sorted(CONFIGS.glob("*.yaml")) if not _of_a_command(p))
        case "campaign":
            yield (CONFIGS / "agarose_twin.yaml").read_bytes()
        case "csv":
            yield SERIES
            yield SERIES.replace(b",", b";").replace(b"t_us", b"# by hand\nt_us")
        case "covariance":
            yield b"1.0,0.2,0\n0.2,1.5,0.1\n0,0.1,2\n"
        case "mat":
            from scipy.io import savemat

            for compressed in (False, True):
                file = io.BytesIO()
                savemat(file, {"R": 1e-4 * np.linspace(1, 0.3, 9), "dt": 1e-6}, do_compression=compressed)
                yield file.getvalue()
        case "mat 7.3":
            import h5py

            file = io.BytesIO()
            with h5py.File(file, "w", userblock_size=512) as hdf:
                hdf["R"], hdf["dt"] = 1e-4 * np.linspace(1, 0.3, 9)[None], [[1e-6]]
            yield b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM" + file.getvalue()[128:]
        case "workbook":
            from openpyxl import Workbook

            book, file = Workbook(), io.BytesIO()
            for line in SERIES.decode().split():
                cells = line.split(",")
                book.active.append(cells if "_" in line else [float(cell) for cell in cells])
            book.save(file)
            yield file.getvalue()
        case "quantity":
            yield from (b"1.5 Pa s", b"-2e3 mPa*s", b"3 kg/m/s", b"4 (N/m^2) s")
        case _:
            raise ValueError(f"no seeds for {target!r}")


def _of_a_command(path: Path) -> bool:
    """Study and campaign files belong to commands of their own."""
    return path.stem == "agarose_study" or path.stem.endswith("_twin")
