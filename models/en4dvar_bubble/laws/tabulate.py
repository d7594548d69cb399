"""From the functions of a law to its tables: elastic and memory functions on ln λ, the mean viscosity on ln |V|."""

from collections.abc import Callable

import numpy as np

from en4dvar.model.state import Array
from en4dvar_bubble.tables import HALO, Grid, evaluate, from_slopes, from_values

Function = Callable[[Array], float | Array]

GRID = Grid(origin=-5.0, step=1 / 32, cells=496)
"""ln λ from e⁻⁵ to e^10.5."""
STRETCH = np.exp(GRID.nodes)

# Strain energies that grow exponentially need derivatives from a finer grid than the cells of the table:
# at 100 MPa a Fung material is then right to 1e-5 instead of 1e-3.
_REFINE = 2
_FINE = Grid(GRID.origin, GRID.step / _REFINE, GRID.cells * _REFINE)
_FINE_LOG = _FINE.nodes
_FINE_STRETCH = np.exp(_FINE_LOG)
_UNSTRETCHED = int(np.flatnonzero(_FINE_LOG == 0.0)[0])
# Interpolation of the removable 0/0 at λ = 1 from the four nodes on either side (eighth order).
_ACROSS = np.array([0.8, -0.4, 4 / 35, -1 / 70])

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


def from_function(function: Function, n: int) -> Array:
    """Table (N, cells, 8) of ``function``: stretch (K,) → broadcastable to (N, K)."""
    return from_values(np.array(np.broadcast_to(function(STRETCH), (n, len(STRETCH))), dtype=float, order="C"))


def from_strain_energy(rate: Function, n: int) -> Array:
    """Table (N, cells, 8) of J_e from W′: dJ_e/d ln λ = −λ W′(λ)/(λ³ − 1), J_e(1) = 0."""
    fine = -_FINE_STRETCH * rate(_FINE_STRETCH) / np.expm1(3 * _FINE_LOG)
    slopes = np.array(np.broadcast_to(fine, (n, len(_FINE_STRETCH))))
    near = [slopes[:, _UNSTRETCHED + k] + slopes[:, _UNSTRETCHED - k] for k in (1, 2, 3, 4)]
    slopes[:, _UNSTRETCHED] = sum(w * s for w, s in zip(_ACROSS, near, strict=True))
    return np.asarray(from_slopes(slopes, _FINE.step, _UNSTRETCHED - HALO, _REFINE))


def differentiate(table: Array) -> Array:
    """The derivative with respect to ln λ of tables (…, cells, 8) on :data:`GRID`, as tables."""
    out = np.zeros_like(table)
    out[..., :5] = table[..., 1:6] * np.arange(1, 6) / GRID.step * np.maximum(table[..., 6:7], 1.0)
    out[..., 6:] = table[..., 6:]
    return out


def ends(tables: Array) -> list[str]:
    """For each of tables (N, cells, 8) of J_e, in words, between which stretches it has values, to half a per cent."""
    x, words = np.arange(GRID.origin, GRID.span[1], GRID.step / 8), []
    for known in np.isfinite(evaluate(tables, GRID.span, np.tile(x, (len(tables), 1)))):
        low, high = np.max(x[~known & (x <= 0)], initial=x[0]), np.min(x[~known & (x >= 0)], initial=x[-1])
        words.append(f": the law has values at stretches between {np.exp(low):.3g} and {np.exp(high):.3g} alone")
    return words


def from_viscosity(viscosity: Function, n: int) -> Array:
    """Table (N, cells, 8) on :data:`VISCOUS_GRID` of μ̄(V) = ∫₀¹ μ(2√3 |V| s) ds, Pa s: what a spherical flow sees.

    viscosity: shear rate (K,) in 1/s → (N, K) in Pa s, or broadcastable to it.
    """
    mu = np.broadcast_to(viscosity(_SHEAR_RATE), (n, len(_SHEAR_RATE)))
    cells = (mu * np.exp(_LOG_RATE)).reshape(n, -1, len(_POINTS)) @ (0.5 * VISCOUS_GRID.step * _WEIGHTS)
    upto = np.cumsum(cells, axis=1)[:, _BELOW - 1 :]
    return from_values(np.asarray(upto / np.exp(_LOG_NODES)))
