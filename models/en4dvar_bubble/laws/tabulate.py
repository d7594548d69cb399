"""From the functions of a law to its tables: elastic and memory functions on ln λ, the mean viscosity on ln |V|."""

from collections.abc import Callable

import numpy as np

from en4dvar.model.state import Array
from en4dvar_bubble.tables import GAUSS, Grid, evaluate, from_values, to_coefficients

Function = Callable[[Array], float | Array]

GRID = Grid(origin=-5.0, step=1 / 32, cells=496)
"""ln λ from e⁻⁵ to e^10.5."""
STRETCH = np.exp(GRID.nodes)

# The slope of J_e in a cell is the polynomial through its values at five Gauss points; at 100 MPa a Fung material is
# then right to 1e-5. No point lies at λ = 1, where the slope is 0/0.
_LOG_GAUSS = GRID.within(GAUSS).ravel()
_TO_RISE = to_coefficients(GAUSS) * GRID.step / np.arange(1, 6)
_UNSTRETCHED = int(np.searchsorted(_LOG_GAUSS, 0.0)) // len(GAUSS)

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


def slope(rate: Function, x: Array) -> Array:
    """dJ_e/d ln λ = −λ W′(λ)/(λ³ − 1) at ln λ = ``x`` (K,), none of them zero, from W′ as ``rate``."""
    stretch = np.exp(x)
    return np.asarray(rate(stretch) * (-stretch / np.expm1(3 * x)))


def from_strain_energy(rate: Function, n: int) -> Array:
    """Table (N, cells, 8) of J_e from W′, J_e(1) = 0. It ends a cell or two before W′, which may grow without bound."""
    slopes = np.broadcast_to(slope(rate, _LOG_GAUSS), (n, len(_LOG_GAUSS))).reshape(n, GRID.cells, -1)
    table, rise = np.zeros((n, GRID.cells, 8)), slopes @ _TO_RISE.sum(axis=1)
    unknown = np.isnan(rise)
    rise[:, 2:][unknown[:, :-2]] = rise[:, :-2][unknown[:, 2:]] = np.nan
    table[..., 1:6] = slopes @ _TO_RISE
    table[..., 0] = accumulated(rise, _UNSTRETCHED)
    return table


def accumulated(rise: Array, zero: int) -> Array:
    """On the left of cells (…, cells) in which a function rises by so much: its values, zero on the left of one."""
    after, before = np.cumsum(rise[..., zero:], axis=-1), np.cumsum(rise[..., :zero][..., ::-1], axis=-1)[..., ::-1]
    return np.concatenate([-before, after - rise[..., zero:]], axis=-1)


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
        if not known.any():
            words.append(
                ": the law has no value at any stretch with these parameters; 'en4dvar laws NAME' says what it needs"
            )
            continue
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
