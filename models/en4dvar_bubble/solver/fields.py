"""Temperatures of the gas, fractions of vapour and temperatures of the medium at the nodes: rates and Jacobian.

The equations are those of :mod:`general`. With τ' and ∇²τ from the collocation matrices every rate is a function of
the node's own values and of what the fields read of the border, so that each block of the Jacobian is a sum of
collocation matrices with scaled rows, and its columns of the border are derivatives with respect to ten numbers.
"""

import numba as nb

from en4dvar.plumbing.compiled import called, inlined
from en4dvar_bubble.solver import rows
from en4dvar_bubble.solver.equations import products
from en4dvar_bubble.solver.general import begins, border_rates, sums
from en4dvar_bubble.solver.lanes import absolute, any_lane, exp, load, log, maximum, splat, sqrt, store
from en4dvar_bubble.solver.tiles import EDGE, place

_DELTA = 1e-7  # relative, of differences with respect to the border
# Rows of the scratch: k, θ, θ^b; τ' (and at the wall), ∇²τ; Y' (likewise), ∇²Y; θ_m' (likewise), ∇²θ_m.


def scratch_rows(dims):
    """How many rows of scratch the fields need."""
    return int(_of_medium.py_func(dims.gas)) + 2 * dims.medium + 1


@nb.njit
def _of_medium(mT):
    """The first row of the scratch that is the medium's."""
    return 7 * mT + 2


@inlined
def _theta(tau, k):
    """θ = 1 + 2τ/(k+1) and 1/θ by one division, which takes the time of ten multiplications."""
    below = k + 1.0
    above = below + tau * 2.0
    inverse = 1.0 / (below * above)
    return above * above * inverse, below * below * inverse


@called
def _add_wall(value, count, matrix, work, at):
    """What the value at the wall adds to the derivatives in ``work``."""
    for i in range(2 * count + 1):
        store(work, at + i, load(work, at + i) + value * matrix[i, count])


@called
def _sum_up(y, eq, par, work, border):
    """The interior's share in the derivatives, to ``work``, and in the sums of the border; returns θ_m' at the wall."""
    mT, mY, mM = eq.dims.gas, eq.dims.vapour, eq.dims.medium
    if mT == 0:
        return splat(0.0)
    a, power = load(par, rows.SLOPE), load(par, rows.DIFFUSION_T)
    content = splat(0.0)
    for i in range(mT):
        tau = load(y, i)
        k = sqrt(maximum(a * tau * 2.0 + 1.0, 1e-12))
        theta, inverse = _theta(tau, k)
        store(work, i, k)
        store(work, mT + i, theta)
        share = inverse * eq.gas[2 * mT + 2, i]
        if mY:
            share = share * load(y, mT + i)
            store(work, 2 * mT + i, splat(1.0))
            if any_lane(power > 0.0):
                store(work, 2 * mT + i, exp(power * log(maximum(theta, 1e-12))))
        content = content + share
    store(border, rows.CONTENT_SUM, content)
    store(border, rows.SLOPE_SUM, products(y, 0, mT, eq.gas, work, 3 * mT))
    if mY:
        store(border, rows.VAPOUR_SUM, products(y, mT, mY, eq.gas, work, 5 * mT + 1))
    return products(y, mT + mY, mM, eq.medium, work, _of_medium(mT))


@called
def _rates(eq, par, shared, work, out):
    """Rates of the fields to ``out``; the derivatives in ``work`` are completed."""
    mT, mY, mM = eq.dims.gas, eq.dims.vapour, eq.dims.medium
    gas, medium = eq.gas, eq.medium
    if mT == 0:
        return
    kappa, power = load(par, rows.KAPPA), load(par, rows.DIFFUSION_T)
    k1 = (kappa - 1.0) / kappa
    E, rate, drift_V = load(shared, rows.CONDUCT), load(shared, rows.RATE), load(shared, rows.DRIFT)
    _add_wall(load(shared, rows.TAU_WALL), mT, gas, work, 3 * mT)
    if mY:
        _add_wall(load(shared, rows.GAS_WALL), mY, gas, work, 5 * mT + 1)
    for i in range(mT):
        conduct = load(work, i) * load(work, mT + i)
        slope, bend = load(work, 3 * mT + i), load(work, 4 * mT + 1 + i)
        drift = k1 * E * slope - drift_V * gas[2 * mT + 1, i]
        store(out, i, k1 * conduct * (rate + E * bend) - drift * slope)
        if mY:
            slope_y, bend_y = load(work, 5 * mT + 1 + i), load(work, 6 * mT + 2 + i)
            spread = load(shared, rows.DIFFUSE) * load(work, 2 * mT + i)
            store(out, mT + i, spread * (bend_y + (power - 1.0) * slope / conduct * slope_y) - drift * slope_y)
    if mM:
        at = _of_medium(mT)
        _add_wall(load(shared, rows.HOT), mM, medium, work, at)
        for j in range(mM):
            flow = load(shared, rows.FLOW) * medium[2 * mM + 1, j] * load(work, at + j)
            heating = load(shared, rows.HEAT) * medium[2 * mM + 2, j]
            store(out, mT + mY + j, flow + load(shared, rows.SPREAD) * load(work, at + mM + 1 + j) + heating)


@called
def general_rhs(y, t, eq, loaded, w):
    """Write dy/dt (n, 8) to ``f``; the wall's rows hold the residuals of its algebraic equations. ``w`` leaves what the
    Jacobian needs; returns θ_m' at the wall but for the wall's own share.
    """
    fields, kept = eq.dims.gas + eq.dims.vapour + eq.dims.medium, sums(eq.dims)
    own = len(y) - fields
    outward = _sum_up(y, eq, loaded.par, w.work, w.border)
    for i in range(own):
        store(w.border, kept + i, load(y, fields + i))
    border_rates(w.border, t, outward, eq, loaded, w.shared, w.border_f)
    for i in range(own):
        store(w.f, fields + i, load(w.border_f, kept + i))
    _rates(eq, loaded.par, w.shared, w.work, w.f)
    return outward


@called
def _gas_blocks(y, eq, par, w):
    """Minus the derivatives of the gas's rates and of the sums with respect to τ and Y, to ``tiles``."""
    mT, mY = eq.dims.gas, eq.dims.vapour
    ops, work, shared, matrix, where = eq.gas, w.work, w.shared, w.tiles, eq.where
    first_Y, _, border = begins(eq.dims)
    a, kappa, power = load(par, rows.SLOPE), load(par, rows.KAPPA), load(par, rows.DIFFUSION_T)
    k1 = (kappa - 1.0) / kappa
    E, rate, drift_V = load(shared, rows.CONDUCT), load(shared, rows.RATE), load(shared, rows.DRIFT)
    for i in range(mT):
        k, theta = load(work, i), load(work, mT + i)
        slope, bend = load(work, 3 * mT + i), load(work, 4 * mT + 1 + i)
        conduct, y_V = k * theta, drift_V * ops[2 * mT + 1, i]
        own = a * theta / k + 1.0  # of kθ
        on_slope, on_bend = y_V - k1 * E * slope * 2.0, k1 * conduct * E
        row, diagonal = place(where, i, 0), place(where, i, i)
        for j in range(mT):
            store(matrix, row + j * EDGE, -(on_slope * ops[i, j] + on_bend * ops[mT + 1 + i, j]))
        store(matrix, diagonal, load(matrix, diagonal) - k1 * own * (rate + E * bend))
        share = ops[2 * mT + 2, i] / theta
        store(matrix, place(where, border + rows.SLOPE_SUM, i), splat(-ops[mT, i]))
        if mY == 0:
            store(matrix, place(where, border + rows.CONTENT_SUM, i), share / conduct)
            continue
        slope_y, bend_y = load(work, 5 * mT + 1 + i), load(work, 6 * mT + 2 + i)
        store(matrix, place(where, border + rows.CONTENT_SUM, i), share / conduct * load(y, mT + i))
        store(matrix, place(where, border + rows.CONTENT_SUM, first_Y + i), -share)
        store(matrix, place(where, border + rows.VAPOUR_SUM, first_Y + i), splat(-ops[mT, i]))
        spread = load(shared, rows.DIFFUSE) * load(work, 2 * mT + i)
        mix = spread * (power - 1.0) / conduct
        row, diagonal = place(where, first_Y + i, 0), place(where, first_Y + i, i)
        row_y = place(where, first_Y + i, first_Y)
        on_slope, on_slope_y = (mix - k1 * E) * slope_y, mix * slope + y_V - k1 * E * slope
        for j in range(mT):
            store(matrix, row + j * EDGE, -(on_slope * ops[i, j]))
            store(matrix, row_y + j * EDGE, -(on_slope_y * ops[i, j] + spread * ops[mT + 1 + i, j]))
        curved = power * (spread * bend_y + mix * slope * slope_y) - mix * own * slope * slope_y
        store(matrix, diagonal, load(matrix, diagonal) - curved / conduct)


@called
def _medium_block(eq, par, w):
    """The same of the medium's, and of the residual of the wall."""
    medium, mM, shared, matrix, where = eq.medium, eq.dims.medium, w.shared, w.tiles, eq.where
    _, first, border = begins(eq.dims)
    wall = border + sums(eq.dims)
    for i in range(mM):
        flow, row = load(shared, rows.FLOW) * medium[2 * mM + 1, i], place(where, first + i, first)
        for j in range(mM):
            value = flow * medium[i, j] + load(shared, rows.SPREAD) * medium[mM + 1 + i, j]
            store(matrix, row + j * EDGE, -value)
        store(matrix, place(where, wall, first + i), -(load(par, rows.MEDIUM_K) * medium[mM, i]))


@called
def _border_column(column, eq, par, change, w):
    """Minus the derivatives of the fields' rates with respect to an unknown of the border, from those of ``shared``."""
    mT, mY, mM = eq.dims.gas, eq.dims.vapour, eq.dims.medium
    gas, medium, work, shared, matrix, where = eq.gas, eq.medium, w.work, w.shared, w.tiles, eq.where
    first_Y, first_M, _ = begins(eq.dims)
    kappa, power = load(par, rows.KAPPA), load(par, rows.DIFFUSION_T)
    k1 = (kappa - 1.0) / kappa
    E, drift_V = load(shared, rows.CONDUCT), load(shared, rows.DRIFT)
    for i in range(mT):
        conduct = load(work, i) * load(work, mT + i)
        slope, bend = load(work, 3 * mT + i), load(work, 4 * mT + 1 + i)
        radius = gas[2 * mT + 1, i]
        drift = load(change, rows.DRIFT) * radius - k1 * slope * load(change, rows.CONDUCT)
        wall_slope = load(change, rows.TAU_WALL) * gas[i, mT]
        wall_bend = load(change, rows.TAU_WALL) * gas[mT + 1 + i, mT]
        heat = load(change, rows.RATE) + load(change, rows.CONDUCT) * bend + E * wall_bend
        carried = drift_V * radius - k1 * E * slope
        total = k1 * conduct * heat + drift * slope + (carried - k1 * E * slope) * wall_slope
        store(matrix, place(where, i, column), -total)
        if mY:
            slope_y, bend_y, at_T = load(work, 5 * mT + 1 + i), load(work, 6 * mT + 2 + i), load(work, 2 * mT + i)
            spread, mix = load(shared, rows.DIFFUSE) * at_T, (power - 1.0) / conduct
            wall_slope_y = load(change, rows.GAS_WALL) * gas[i, mT]
            total = load(change, rows.DIFFUSE) * at_T * (bend_y + mix * slope * slope_y)
            total = total + spread * (load(change, rows.GAS_WALL) * gas[mT + 1 + i, mT] + mix * slope * wall_slope_y)
            total = total + (spread * mix - k1 * E) * wall_slope * slope_y + drift * slope_y + carried * wall_slope_y
            store(matrix, place(where, first_Y + i, column), -total)
    for i in range(mM):
        flow, at, hot = medium[2 * mM + 1, i], _of_medium(mT) + i, load(change, rows.HOT)
        total = load(change, rows.FLOW) * flow * load(work, at) + load(change, rows.SPREAD) * load(work, at + mM + 1)
        total = total + load(change, rows.HEAT) * medium[2 * mM + 2, i]
        total = total + load(shared, rows.SPREAD) * hot * medium[mM + 1 + i, mM]
        total = total + load(shared, rows.FLOW) * flow * hot * medium[i, mM]
        store(matrix, place(where, first_M + i, column), -total)


@called
def general_jacobian(y, t, eq, loaded, w):
    """Write dy/dt to ``f`` of the workspace, minus its derivatives in the extended form of :mod:`general` to ``tiles``
    and ∂f_V/∂t to ``dt``. Those with respect to the border are one-sided differences.
    """
    kept, par, own, where = sums(eq.dims), loaded.par, len(w.border), eq.where
    _, _, first = begins(eq.dims)
    outward = general_rhs(y, t, eq, loaded, w)
    for i in range(len(w.tiles)):
        store(w.tiles, i, 0.0)
    _gas_blocks(y, eq, par, w)
    if eq.dims.wall:
        _medium_block(eq, par, w)
    moved, changed, now = w.moved, w.moved_f, load(t, 0)
    store(t, 0, now + _DELTA)
    late = load(t, 0)
    gas_wall = kept + eq.dims.wall if eq.dims.kinetic else -1
    for b in range(-1, own):  # time comes first
        value = load(w.border, max(b, 0))
        inverse = 1.0 / (late - now)
        if b >= 0:
            floor_b = 0.01 if b == own - 2 else 0.0 if kept and b in (rows.CONTENT_SUM, gas_wall) else 1.0
            store(w.border, b, value + maximum(absolute(value), floor_b) * _DELTA)
            inverse = 1.0 / (load(w.border, b) - value)
        border_rates(w.border, t, outward, eq, loaded, moved, changed)
        store(t, 0, now)
        if b < 0:
            store(w.dt, 0, (load(changed, own - 2) - load(w.border_f, own - 2)) * inverse)
            continue
        store(w.border, b, value)
        for i in range(rows.SHARED):
            store(moved, i, (load(moved, i) - load(w.shared, i)) * inverse)
        _border_column(first + b, eq, par, moved, w)
        for i in range(kept, own):
            at = place(where, first + i, first + b)
            store(w.tiles, at, (load(w.border_f, i) - load(changed, i)) * inverse)
