"""From the functions of a law to its tables on the grid of ln λ."""

from __future__ import annotations

from collections.abc import Callable

import numba as nb
import numpy as np

from en4dvar.state import Array
from en4dvar_bubble.tables import HALO, Grid, _cell, from_slopes, from_values

GRID = Grid(origin=-5.0, step=1 / 32, cells=496)
STRETCH = np.exp(GRID.nodes)

# Strain energies that grow exponentially need derivatives from a finer grid than the cells of the table:
# at 100 MPa a Fung material is then right to 1e-5 instead of 1e-3.
_REFINE = 2
_FINE = Grid(GRID.origin, GRID.step / _REFINE, (GRID.cells + 1) * _REFINE)
_FINE_LOG = _FINE.nodes
_FINE_STRETCH = np.exp(_FINE_LOG)
_UNSTRETCHED = int(np.flatnonzero(_FINE_LOG == 0.0)[0])
# Interpolation of the removable 0/0 at λ = 1 from the four nodes on either side (eighth order).
_ACROSS = np.array([0.8, -0.4, 4 / 35, -1 / 70])


def sample(function: Callable[[Array], Array], n: int) -> Array:
    """``function``, stretch (K,) → broadcastable to (N, K), at the nodes of the grid and its halo."""
    return np.ascontiguousarray(np.broadcast_to(function(STRETCH), (n, len(STRETCH))), dtype=float)


def from_function(function: Callable[[Array], Array], n: int) -> Array:
    """Table (N, cells, 8) of ``function``: stretch (K,) → broadcastable to (N, K)."""
    return from_values(sample(function, n))


def from_strain_energy(rate: Callable[[Array], Array], n: int) -> Array:
    """Table (N, cells, 8) of `` · J_e`` from W′: dJ_e/d ln λ = −λ W′(λ)/(λ³ − 1), J_e(1) = 0."""
    fine = -_FINE_STRETCH * rate(_FINE_STRETCH) / np.expm1(3 * _FINE_LOG)
    slopes = np.array(np.broadcast_to(fine, (n, len(_FINE_STRETCH))))
    near = [slopes[:, _UNSTRETCHED + k] + slopes[:, _UNSTRETCHED - k] for k in (1, 2, 3, 4)]
    slopes[:, _UNSTRETCHED] = sum(w * s for w, s in zip(_ACROSS, near, strict=True))
    return np.asarray(_coarsen(from_slopes(slopes, _FINE.step, _UNSTRETCHED - HALO), _REFINE, GRID.cells))


@nb.njit(cache=True, nogil=True)
def _coarsen(fine, ratio, cells):  # type: ignore[no-untyped-def]
    """Cells as wide as ``ratio`` fine ones, with value, slope and curvature of the fine table at their ends."""
    n = fine.shape[0]
    out = np.empty((n, cells, 8))
    for i in range(n):
        for j in range(cells):
            a, b = fine[i, j * ratio], fine[i, (j + 1) * ratio]
            first, second = float(ratio), 2.0 * ratio * ratio
            _cell(out[i, j], a[0], a[1] * first, a[2] * second, b[0], b[1] * first, b[2] * second)
    return out


def differentiate(table: Array) -> Array:
    """The derivative with respect to ln λ of tables (…, cells, 8) on :data:`GRID`, as tables."""
    out = np.zeros_like(table)
    out[..., :5] = table[..., 1:6] * np.arange(1, 6) / GRID.step
    return out
