"""What drives a bubble: a pressure in the far field that is zero outside a span of time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from en4dvar.state import Array
from en4dvar_bubble.tables import Grid

Reading = Literal["instantaneous", "retarded", "as-printed"]

# The quintic of a cell through its values at six Chebyshev–Lobatto points, both ends among them.
_POINTS = 0.5 - 0.5 * np.cos(np.pi * np.arange(6) / 5)
_TO_COEFFICIENTS = np.linalg.inv(np.vander(_POINTS, increasing=True))
_LARGEST_JUMP = 1e-6


@dataclass(frozen=True)
class Driving:
    """p_f = amplitude · shape(t) on [begin, end] (seconds), zero outside.

    ``shape`` takes times in seconds (array) and is tabulated once on ``cells`` equal cells. It must be continuous,
    zero at both ends, and smooth inside every cell; where it is only continuous, at the edge of a cell, or would be
    stepped over, name the instant in ``stops`` (seconds): no time step straddles one.

    Raises
    ------
    ValueError: an empty span, or a shape that jumps at an end: dp_f/dt, which the Keller–Miksis equation contains,
        would be infinite there.
    """

    amplitude: float
    begin: float
    end: float
    shape: Callable[[Array], Array]
    cells: int = 512
    stops: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if not self.end > self.begin:
            raise ValueError(f"the driving ends at {self.end:g} s, not after its beginning at {self.begin:g} s")
        first, last = np.abs(self.shape(np.array([self.begin, self.end])))
        if max(first, last) > _LARGEST_JUMP:
            where, jump = ("beginning", first) if first >= last else ("end", last)
            raise ValueError(f"the driving pressure jumps at its {where} by {jump:.3g} of its amplitude")

    @property
    def silent(self) -> bool:
        """Whether nothing is driven."""
        return self.amplitude == 0.0

    @cached_property
    def grid(self) -> Grid:
        """In µs, the solver's unit."""
        return Grid(self.begin * 1e6, (self.end - self.begin) * 1e6 / self.cells, self.cells)

    @cached_property
    def table(self) -> Array:
        """(cells, 8) coefficients of ``shape``: six of the quintic in the cell's own coordinate, two zeros."""
        grid = self.grid
        times = grid.origin + grid.step * (np.arange(self.cells)[:, None] + _POINTS)
        samples = self.shape(times.ravel() * 1e-6).reshape(times.shape)
        table = np.zeros((self.cells, 8))
        table[:, :6] = samples @ _TO_COEFFICIENTS.T
        return table

    @cached_property
    def span(self) -> Array:
        """(begin, end, cells per µs, cells) of the table."""
        return self.grid.span

    @cached_property
    def breaks(self) -> Array:
        """Instants (µs, increasing) at which a time step must end: the stops and both ends; none when silent."""
        if self.silent:
            return np.empty(0)
        inside = [1e6 * t for t in sorted(set(self.stops)) if self.begin < t < self.end]
        first, last, _, _ = self.grid.span
        return np.array([first, *(t for t in inside if first < t < last), last])

    def pressure(self, t: Array) -> Array:
        """p_f in Pa at times (K,) in s, of any shape."""
        t = np.asarray(t, dtype=float)
        return np.where((t >= self.begin) & (t <= self.end), self.amplitude * self.shape(t), 0.0)
