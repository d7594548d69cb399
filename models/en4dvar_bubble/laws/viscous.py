"""The viscosity that a spherical flow sees: the shear-dependent viscosity averaged over the medium."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from en4dvar.state import Array
from en4dvar_bubble.tables import Grid

_LOWEST, _HIGHEST = np.log(1e-3), np.log(1e13)
_CELLS = 384

VISCOUS_GRID = Grid(origin=_LOWEST, step=(_HIGHEST - _LOWEST) / _CELLS, cells=_CELLS)
"""z = ln(|V| s) from |V| = 1e-3 to 1e13 1/s."""

# ∫₀^γ μ dγ as a sum of cells in ln γ, eight Gauss points each. A knee of the viscosity is about as wide in ln γ as
# one, ten cells, whatever its shear rate. Below the first node 1024 cells reach down to γ = e^-98 of it, so that a
# power law with exponent n > 0.2 is integrated to 1e-8.
_BELOW = 1024
_POINTS, _WEIGHTS = np.polynomial.legendre.leggauss(8)
_LOG_NODES = VISCOUS_GRID.nodes
_EDGES = _LOG_NODES[0] + VISCOUS_GRID.step * np.arange(-_BELOW, len(_LOG_NODES) - 1)
_LOG_RATE = (_EDGES[:, None] + 0.5 * VISCOUS_GRID.step * (_POINTS + 1)).ravel()
_SHEAR_RATE = 2 * np.sqrt(3) * np.exp(_LOG_RATE)


def mean_viscosity(viscosity: Callable[[Array], Array], n_members: int) -> Array:
    """μ̄(V) = ∫₀¹ μ(2√3 |V| s) ds at the nodes of :data:`VISCOUS_GRID`: (N, nodes), Pa s.

    viscosity: shear rate (K,) in 1/s → (N, K) in Pa s, or broadcastable to it.
    """
    mu = np.broadcast_to(viscosity(_SHEAR_RATE), (n_members, len(_SHEAR_RATE)))
    cells = (mu * np.exp(_LOG_RATE)).reshape(n_members, -1, len(_POINTS)) @ (0.5 * VISCOUS_GRID.step * _WEIGHTS)
    upto = np.cumsum(cells, axis=1)[:, _BELOW - 1 :]
    return np.asarray(upto / np.exp(_LOG_NODES))
