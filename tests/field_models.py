"""A field along a line that stays as it is, read at its cells, and a mean of it with an offset: linear in both."""

from __future__ import annotations

import numpy as np

from en4dvar.model.forward import ForwardModel, Observable, StateField
from en4dvar.model.state import Field, Parameter, StateLayout

PLACES = 0.5 * np.arange(30)  # m


class Level:
    """The mean of the first three cells plus the offset, at every time."""

    def __call__(self, trajectory):
        return trajectory["u"][:, :3].mean(axis=1) + trajectory["offset"]


class Line(ForwardModel):
    parameters = (Parameter("offset", "1"),)
    layout = StateLayout((Field("u", 30, unit="K", coordinates=PLACES, coordinate_unit="m"), Field("offset")))
    observables = (Observable("u", "K", StateField("u")), Observable("level", "K", Level()))
    base = 2.0

    def initial_state(self, theta):
        return np.append(np.full(30, self.base), theta["offset"])

    def step(self, x, t0, t1):
        return x


class Fragile(Line):
    """Fails where its first cell is more than a kelvin above what it starts with."""

    def step(self, x, t0, t1):
        if x[0] > self.base + 1:
            raise ValueError("too hot")
        return x


class Many(ForwardModel):
    """2000 parameters and nothing else."""

    parameters = tuple(Parameter(f"k_{i}", "1") for i in range(2000))
    layout = StateLayout((Field("k", 2000),))
    observables = (Observable("k", "1", StateField("k")),)

    def initial_state(self, theta):
        return np.array([theta[p.name] for p in self.parameters])

    def initial_states(self, theta):
        return np.stack([theta[p.name] for p in self.parameters], axis=1)

    def step(self, x, t0, t1):
        return x


YAML = """\
name: line
seed: 4
model: {name: "field_models:Line"}
data:
  path: line.csv
  columns:
    time: {name: t, unit: s}
    u: {name: u, unit: K}
  places: {column: cell}
  error: {u_std: 0.3 K}
parameters: {offset: 0}
initial_state:
  u: {std: 1 K, kernel: gaussian, length: 150 cm}
assimilation:
  members: 12
  localisation: {radius: 300 cm}
"""
READ = np.array([1, 4, 11, 17, 26, 4])
TIMES = np.array([1.0, 1.0, 1.0, 1.0, 1.0, 2.0])
VALUES = np.array([2.5, 2.9, 1.2, 0.9, 3.1, 2.7])
CSV = "t,cell,u,w\n" + "".join(
    f"{t:g},{c},{v},{w}\n" for t, c, v, w in zip(TIMES, READ, VALUES, (1, 1, 0, 1, 1, 1), strict=True)
)


def write_line(folder, *changes, data=CSV):
    """The configuration with replacements applied, in ``folder`` beside its data file."""
    text = YAML
    for old, new in changes:
        assert old in text, old
        text = text.replace(old, new, 1)
    (folder / "line.yaml").write_text(text, encoding="utf-8")
    (folder / "line.csv").write_text(data, encoding="utf-8")
    return folder / "line.yaml"
