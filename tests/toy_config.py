"""A complete configuration of the toy oscillator with its data file."""

from __future__ import annotations

from pathlib import Path

import numpy as np

YAML = """\
name: toy
seed: 3
data:
  path: toy.csv
  columns:
    time: {name: t_ms, unit: ms}
    position: {name: x_um, unit: um}
  error: {position_std: 2 um}
model:
  name: toy_models:Oscillator
  mass: 2 g
parameters:
  A: {prior: normal, mean: maximum, std: 1 %}
  k: {prior: lognormal, median: 3 N/m, log_std: 0.3}
  c: 0.02 N s/m
assimilation:
  members: 8
  max_iterations: 8
"""


def csv_text(n: int = 31, k: float = 2.0, c: float = 0.02, m: float = 2e-3, nth: int = 0) -> str:
    """A damped oscillation of 100 µm every 5 ms, in closed form; the ``nth`` recording, moved by as many nm."""
    t = np.arange(n) * 5e-3
    a, w = c / (2 * m), np.sqrt(k / m - (c / (2 * m)) ** 2)
    x = 100 * np.exp(-a * t) * (np.cos(w * t) + a / w * np.sin(w * t)) + 1e-3 * nth
    return "# toy\nt_ms,x_um\n" + "".join(f"{1e3 * a:.6g},{b:.6g}\n" for a, b in zip(t, x, strict=True))


def write_toy(folder: Path, *replacements: tuple[str, str], data: str | None = None) -> Path:
    """The configuration with replacements applied, in ``folder`` beside its data file."""
    text = YAML
    for old, new in replacements:
        assert old in text
        text = text.replace(old, new, 1)
    path = folder / "toy.yaml"
    path.write_text(text, encoding="utf-8")
    (folder / "toy.csv").write_text(csv_text() if data is None else data, encoding="utf-8")
    return path
