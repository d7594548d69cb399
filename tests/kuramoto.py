"""Kuramoto and Sivashinsky: u_t = −u u_x − u_xx − ν u_xxxx on 128 cells of a ring, the textbook case of 4D-Var."""

from __future__ import annotations

import numpy as np

from en4dvar.model.forward import Batch, ForwardModel, Observable, StateField
from en4dvar.model.state import Field, Parameter, StateLayout
from en4dvar.priors.dependence import correlation_of_places

CELLS, LENGTH, STEP = 128, 100.0, 0.25
PLACES = np.arange(CELLS) * LENGTH / CELLS
WAVES = 2 * np.pi * np.fft.rfftfreq(CELLS, LENGTH / CELLS)


class Energy:
    """The mean of u² over the ring: of the whole field, and of no place."""

    batched = True

    def __call__(self, path):
        return np.mean(path["u"] ** 2, axis=-1)


class Kuramoto(ForwardModel):
    """By ETDRK4 (Cox & Matthews 2002; Kassam & Trefethen 2005), all members at once."""

    parameters = (Parameter("nu", "1", bounds=(0.3, 3.0)),)
    layout = StateLayout((Field("u", CELLS, coordinates=PLACES), Field("nu")))
    observables = (Observable("u", "1", StateField("u")), Observable("energy", "1", Energy()))
    time_unit = "1"
    batch = 1000

    def initial_state(self, theta):
        x = PLACES / LENGTH * 2 * np.pi
        return np.append(1.5 * np.cos(12 * x + np.sin(x)) * (1 + 0.3 * np.sin(3 * x)), theta["nu"])

    def trajectories(self, x, times):
        times = np.broadcast_to(times, (len(x), np.shape(times)[-1]))
        states = np.repeat(x[:, None], times.shape[1], axis=1)
        v, nu, t = np.fft.rfft(x[:, :CELLS]), x[:, CELLS:], 0.0
        for k, until in enumerate(times[0]):
            steps = round((until - t) / STEP)
            v, t = self.march(v, nu, steps), until
            states[:, k, :CELLS] = np.fft.irfft(v)
        return Batch(times, states, self.layout)

    @staticmethod
    def march(v, nu, steps):
        h, L = STEP, WAVES**2 - nu * WAVES**4
        z = h * L[..., None] + np.exp(1j * np.pi * (np.arange(1, 33) - 0.5) / 32)
        E, E2, Q = np.exp(h * L), np.exp(h * L / 2), h * np.mean((np.exp(z / 2) - 1) / z, -1).real
        f1 = h * np.mean((-4 - z + np.exp(z) * (4 - 3 * z + z**2)) / z**3, -1).real
        f2 = h * np.mean((2 + z + np.exp(z) * (-2 + z)) / z**3, -1).real
        f3 = h * np.mean((-4 - 3 * z - z**2 + np.exp(z) * (4 - z)) / z**3, -1).real

        def N(w):
            return -0.5j * WAVES * np.fft.rfft(np.fft.irfft(w) ** 2)

        for _ in range(steps):
            n = N(v)
            a = E2 * v + Q * n
            na = N(a)
            b = E2 * v + Q * na
            nb = N(b)
            c = E2 * a + Q * (2 * nb - n)
            v = E * v + n * f1 + 2 * (na + nb) * f2 + N(c) * f3
        return v


YAML = """\
name: ring
seed: 1
model: {name: "kuramoto:Kuramoto"}
data:
  series:
    u:
      path: u.csv
      columns:
        time: {name: t, unit: "1"}
        u: {name: u, unit: "1"}
      places: {column: cell}
      error: {u_std: 0.3}
    energy:
      path: energy.csv
      columns:
        time: {name: t, unit: "1"}
        energy: {name: energy, unit: "1"}
      error: {energy_std: 0.05}
parameters:
  nu: {prior: normal, mean: 1, std: 0.1}
initial_state:
  u: {std: 0.4, kernel: gaussian, length: 5}
assimilation: {members: 60, lengthen: 6}
"""
TIMES, READ, NU = np.arange(2.0, 13.0, 2.0), np.arange(1, CELLS, 4), 1.08


def write_ring(folder, *changes, seed=7, times=TIMES):
    """The configuration with replacements applied, beside its readings in ``folder``: its path, and the true field."""
    text, model, rng = YAML, Kuramoto(), np.random.default_rng(seed)
    for old, new in changes:
        assert old in text, old
        text = text.replace(old, new, 1)
    truth = model.initial_state({"nu": NU})
    C = correlation_of_places("gaussian", model.layout.fields[0].coordinates[:, None], 5.0)
    root = np.linalg.cholesky(C + 1e-8 * np.eye(CELLS))  # eigenvectors would be others on another processor
    truth[:CELLS] += 0.4 * root @ rng.standard_normal(CELLS)
    (path,) = model.trajectories(truth[None], times)
    energy = np.mean(path["u"] ** 2, axis=1) + 0.05 * rng.standard_normal(len(times))
    rows = [
        f"{t:g},{c},{u[c] + 0.3 * rng.standard_normal()}" for t, u in zip(times, path["u"], strict=True) for c in READ
    ]
    (folder / "u.csv").write_text("\n".join(["t,cell,u", *rows]) + "\n", encoding="utf-8")
    rows = [f"{t:g},{e}" for t, e in zip(times, energy, strict=True)]
    (folder / "energy.csv").write_text("\n".join(["t,energy", *rows]) + "\n", encoding="utf-8")
    (folder / "ring.yaml").write_text(text, encoding="utf-8")
    return folder / "ring.yaml", truth[:CELLS]
