"""Heads of a confined aquifer on a grid: storage ∂h/∂t = ∇·(T ∇h) + recharge, h = 0 at the boundary and at first.

Cells have side 1; T = exp(x), with the field x that is estimated. Finite volumes with harmonic means of T between
cells, implicit Euler steps, one factorisation a member. Source: Bear (1979), *Hydraulics of Groundwater*, § 5-1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_matrix, csc_matrix, identity
from scipy.sparse.linalg import splu

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Aquifer:
    """``shape`` (rows, columns) of the grid; ``wells`` (W,) indices of the cells whose heads are read.

    They are read after each number of ``reads`` implicit steps of length ``dt``.
    """

    shape: tuple[int, int]
    wells: npt.NDArray[np.intp]
    reads: tuple[int, ...] = (2, 6, 16)
    dt: float = 2.0
    storage: float = 0.1
    recharge: float = 0.01

    @property
    def size(self) -> int:
        return self.shape[0] * self.shape[1]

    @property
    def places(self) -> Array:
        """Coordinates (n, 2) of the cells."""
        return np.indices(self.shape, dtype=float).reshape(2, -1).T

    @property
    def observed(self) -> Array:
        """Coordinates (K, 2) of the readings in the order of the predictions: all wells, and again at each time."""
        return np.tile(self.places[self.wells], (len(self.reads), 1))

    def __call__(self, fields: Array) -> Array:
        """Heads (M, K) at the wells, of fields ln T (M, n)."""
        return np.array([self._heads(field) for field in fields])

    def _heads(self, field: Array) -> Array:
        system = identity(self.size, format="csc") * (self.storage / self.dt) + self.conductances(field)
        solve, head, read = splu(system.tocsc()).solve, np.zeros(self.size), []
        for step in range(1, max(self.reads) + 1):
            head = solve(head * (self.storage / self.dt) + self.recharge)
            if step in self.reads:
                read.append(head[self.wells])
        return np.concatenate(read)

    def conductances(self, field: Array) -> csc_matrix:
        """−∇·(T ∇·) (n, n): symmetric, with the boundary, half a cell away, at head 0."""
        T = np.exp(field).reshape(self.shape)
        cells = np.arange(self.size).reshape(self.shape)
        diagonal = np.zeros(self.shape)
        rows, columns, values = [], [], []
        for axis in (0, 1):
            a, b = np.moveaxis(T, axis, 0)[:-1], np.moveaxis(T, axis, 0)[1:]
            between = 2 * a * b / (a + b)
            along = np.moveaxis(diagonal, axis, 0)
            along[:-1] += between
            along[1:] += between
            along[0] += 2 * np.moveaxis(T, axis, 0)[0]
            along[-1] += 2 * np.moveaxis(T, axis, 0)[-1]
            one, other = np.moveaxis(cells, axis, 0)[:-1].ravel(), np.moveaxis(cells, axis, 0)[1:].ravel()
            rows += [one, other]
            columns += [other, one]
            values += [-between.ravel()] * 2
        rows.append(cells.ravel())
        columns.append(cells.ravel())
        values.append(diagonal.ravel())
        entries = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
        return coo_matrix(entries, shape=(self.size, self.size)).tocsc()


def gaussian_fields(shape: tuple[int, int], length: float, count: int, rng: np.random.Generator) -> Array:
    """Gaussian fields (count, n) of mean 0 and variance 1, correlated as exp(−½ (r/length)²): cut out of a torus."""
    wide = tuple(side + int(np.ceil(5 * length)) for side in shape)
    squares = sum(np.minimum(i, side - i) ** 2 for i, side in zip(np.indices(wide, dtype=float), wide, strict=True))
    power = np.maximum(np.fft.fft2(np.exp(-0.5 * squares / length**2)).real, 0.0)
    found = np.empty((count, shape[0] * shape[1]))
    for i in range(count):
        white = np.fft.fft2(rng.standard_normal(wide))
        found[i] = np.fft.ifft2(np.sqrt(power) * white).real[: shape[0], : shape[1]].ravel()
    return found
