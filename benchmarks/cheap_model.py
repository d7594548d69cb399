"""A straight line as forward model, and campaigns of it: what is measured is the framework, not the model.

``cheap_model:Unreliable`` loses one member in a hundred, always the same ones: those whose offset, to a millionth of a
millionth, happens to end in two zeros.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from pydantic import BaseModel, ConfigDict

from en4dvar.model.forward import Failure, ForwardModel, Observable, StateField, Trajectory
from en4dvar.model.state import Field, Parameter, StateLayout

YAML = """\
name: campaign
seed: 11
data:
  path: data
  columns:
    time: {{name: t, unit: s}}
    y: {{name: y, unit: m}}
  error: {{y_std: 0.1 m}}
model: {{name: "{model}"}}
parameters:
  a: {{prior: normal, mean: 1 m, std: 1 m}}
  b: {{prior: normal, mean: 0 m/s, std: 1 m/s}}
assimilation: {{members: 12, max_iterations: 6}}
output: {{report: false}}
"""
BAD = {
    "empty": "t,y\n",
    "not a number": "t,y\n0,1\n1,one\n2,3\n3,4\n",
    "not text": "\xff\xfe",
    "no column": "t,z\n0,1\n",
}


class LineSettings(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Line(ForwardModel):
    """y = a + b t."""

    parameters = (Parameter("a", "m"), Parameter("b", "m/s"))
    layout = StateLayout((Field("y", unit="m"), Field("b", unit="m/s")))
    observables = (Observable("y", "m", StateField("y", rate_of="b")),)
    Settings = LineSettings
    batch = 48

    @classmethod
    def from_settings(cls, settings: LineSettings) -> Line:
        return cls()

    def initial_state(self, theta):
        return np.array([theta["a"], theta["b"]])

    def step(self, x, t0, t1):
        return np.array([x[0] + x[1] * (t1 - t0), x[1]])

    def trajectories(self, x, times) -> Sequence[Trajectory | Failure]:
        own = np.broadcast_to(times, (len(x), np.shape(times)[-1]))
        y = x[:, :1] + x[:, 1:] * own
        paths = np.stack([y, np.broadcast_to(x[:, 1:], y.shape)], axis=-1)
        return [Trajectory(own[i], paths[i], self.layout) for i in range(len(x))]


class Unreliable(Line):
    def trajectories(self, x, times):
        unlucky = np.floor(np.abs(x[:, 0]) * 1e12) % 100 == 0
        return [
            Failure("unlucky member") if bad else path
            for path, bad in zip(super().trajectories(x, times), unlucky, strict=True)
        ]


def write_campaign(folder: Path, sets: int, model: str = "cheap_model:Line", bad: int = 0, seed: int = 1) -> Path:
    """A configuration with a folder of ``sets`` data files, every ``bad``-th of them unusable (0: none)."""
    draw = np.random.default_rng(seed)
    (folder / "data").mkdir(parents=True)
    t = np.linspace(0.0, 3.0, 5)
    for i in range(sets):
        a, b = draw.normal(1.0, 1.0), draw.normal(0.0, 1.0)
        y = a + b * t + 0.1 * draw.standard_normal(len(t))
        text = "t,y\n" + "".join(f"{u:.6g},{v:.6g}\n" for u, v in zip(t, y, strict=True))
        if bad and i % bad == bad // 2:
            text = list(BAD.values())[i // bad % len(BAD)]
        (folder / "data" / f"set{i:05d}.csv").write_bytes(text.encode("latin-1"))
    path = folder / "campaign.yaml"
    path.write_text(YAML.format(model=model), encoding="utf-8")
    return path
