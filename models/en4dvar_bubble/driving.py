"""The far-field pressure p_f(t) that drives an acoustic bubble."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from en4dvar.state import Array
from en4dvar_bubble.tables import Grid, from_values

Reading = Literal["instantaneous", "retarded", "as-printed"]


@dataclass(frozen=True)
class Driving:
    """p_f = amplitude · shape(t) on [begin, end] (seconds), zero outside.

    ``shape`` takes times in seconds (array) and must be smooth inside the span; it is tabulated once on ``cells``
    cells.
    """

    amplitude: float
    begin: float
    end: float
    shape: Callable[[Array], Array]
    cells: int = 512

    @cached_property
    def grid(self) -> Grid:
        """In µs, the solver's unit."""
        return Grid(self.begin * 1e6, (self.end - self.begin) * 1e6 / self.cells, self.cells)

    @cached_property
    def table(self) -> Array:
        """(cells, 8) coefficients of ``shape``."""
        return np.ascontiguousarray(from_values(self.shape(self.grid.nodes * 1e-6)[None, :])[0])

    def pressure(self, t: Array) -> Array:
        """p_f at times t (s), Pa."""
        t = np.asarray(t, dtype=float)
        return np.where((t >= self.begin) & (t <= self.end), self.amplitude * self.shape(t), 0.0)


@dataclass(frozen=True)
class _HalfCycle:
    frequency: float
    exponent: float
    delay: float

    def __call__(self, t: Array) -> Array:
        phase = 2 * np.pi * self.frequency * (t - self.delay)
        inside = np.abs(phase) < np.pi
        base = np.where(inside, 0.5 * (1 + np.cos(np.where(inside, phase, np.pi))), 0.0)
        return np.asarray(base**self.exponent)


def histotripsy(
    amplitude: float = -24e6, frequency: float = 1e6, exponent: float = 3.7, delay: float = 5e-6
) -> Driving:
    """The rarefactional half cycle p_A [(1 + cos ω(t−δ))/2]^n for |t−δ| ≤ π/ω.

    Amplitude and frequency are the paper's; n and δ are from the literature on this array (Vlaisavljevich et al. 2015).
    """
    half = 0.5 / frequency
    return Driving(amplitude, delay - half, delay + half, _HalfCycle(frequency, exponent, delay))


def silence() -> Driving:
    """No driving: the laser-induced bubble."""
    return Driving(0.0, 0.0, 1e-6, np.zeros_like, cells=1)
