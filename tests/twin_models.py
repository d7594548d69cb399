"""A model for twin experiments that starts at once: nothing to compile."""

from __future__ import annotations

import os
import time

import numpy as np
from pydantic import BaseModel

from en4dvar.model.forward import Batch, ForwardModel, Observable, StateField
from en4dvar.model.state import Field, StateLayout


class RingSettings(BaseModel):
    """None."""


class Ring(ForwardModel):
    """Waves on a ring, x_i'' = x_{i+1} − 2 x_i + x_{i−1} − x_i³/6, by leapfrog; ``EN4DVAR_TEST_PAUSE`` s a batch."""

    parameters = ()
    layout = StateLayout((Field("x", 6), Field("v", 6)))
    observables = (Observable("x", "1", StateField("x")),)
    autonomous = True
    time_unit = "1"
    pause = float(os.environ.get("EN4DVAR_TEST_PAUSE", "0"))
    stop_at = calls = 0
    Settings = RingSettings

    @classmethod
    def from_settings(cls, settings):
        return cls()

    def initial_state(self, theta):
        return np.concatenate([np.cos(np.arange(6.0)), np.zeros(6)])

    def step(self, x, t0, t1):
        return self.trajectories(x[None], np.array([t1 - t0])).states[0, 0]

    def trajectories(self, x, times):
        type(self).calls += 1
        if type(self).calls == type(self).stop_at:
            raise KeyboardInterrupt
        time.sleep(self.pause)
        own = np.broadcast_to(times, (len(x), np.shape(times)[-1]))
        paths = np.empty((*own.shape, 12))
        for k in range(own.shape[1]):
            h = (own[:, k] - (own[:, k - 1] if k else 0.0))[:, None] / 10
            z, v = x[:, :6], x[:, 6:]
            for _ in range(10):
                v = v + h / 2 * self._force(z)
                z = z + h * v
                v = v + h / 2 * self._force(z)
            x = paths[:, k] = np.concatenate([z, v], axis=1)
        return Batch(np.array(own), paths, self.layout)

    @staticmethod
    def _force(z):
        return np.roll(z, 1, axis=1) - 2 * z + np.roll(z, -1, axis=1) - z**3 / 6
