"""Adaptive integration of many members: eight lanes, each with its own member, time and step, refilled when one
finishes.
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np
from numba.core import types

from en4dvar_bubble.solver import rodas5p
from en4dvar_bubble.solver.equations import jacobian, rhs
from en4dvar_bubble.solver.general import general_jacobian, general_rhs
from en4dvar_bubble.solver.lanes import WIDTH, absolute, exp, load, log, maximum, peek, splat, sqrt, store, take
from en4dvar_bubble.solver.rows import AMPLITUDE, INVERSE_C, TABLE
from en4dvar_bubble.tables import fill

# Status of a member; the reasons users read are made by ``driver.reason``.
OK, STEP_LIMIT, NON_FINITE, STEP_UNDERFLOW, MACH_LIMIT, TIME_LIMIT, WALL_LIMIT = 0, 1, 2, 3, 4, 5, 6
# Columns of the per-member record.
STEPS, REJECTED, MAX_MACH, MAX_THETA, MIN_LOG_R, END_TIME = 0, 1, 2, 3, 4, 5
RECORD = 6

_A, _C, _ALPHA, _D, _H = rodas5p.A, rodas5p.C, rodas5p.ALPHA, rodas5p.D, rodas5p.H
_GAMMA = rodas5p.GAMMA
_STAGES = rodas5p.STAGES
_SAFETY, _SHRINK, _GROW = 0.9, 0.15, 6.0
_EXPONENT = 1.0 / rodas5p.ORDER
_LEAST_ROOT = 1e-2**_EXPONENT
# µs. A bounce may need steps below the spacing of doubles near t: the equations know no other time by then, and the
# step limit bounds the work.
_SHORTEST = 1e-18
_TURNS_PER_LOOK = 64  # attempted steps between looks at the clock

_clock = types.ExternalFunction("time", types.int64(types.intp))  # time(NULL) of the C library, seconds


@nb.njit(forceinline=True)
def _factorise(a, size):
    """LU without pivoting, in place; the diagonal is replaced by its inverse. Rows i·n+j.

    The temperature block comes first and is diagonally dominant; V and u follow as its border.
    """
    n = len(size)
    for k in range(n):
        pivot = 1.0 / load(a, k * n + k)
        store(a, k * n + k, pivot)
        for i in range(k + 1, n):
            factor = load(a, i * n + k) * pivot
            store(a, i * n + k, factor)
            for j in range(k + 1, n):
                store(a, i * n + j, load(a, i * n + j) - factor * load(a, k * n + j))


@nb.njit(forceinline=True)
def _solve(a, size, b, row):
    """Solve in place for the right-hand side in rows ``row … row+n−1`` of ``b``."""
    n = len(size)
    for i in range(1, n):
        total = load(b, row + i)
        for j in range(i):
            total = total - load(a, i * n + j) * load(b, row + j)
        store(b, row + i, total)
    for i in range(n - 1, -1, -1):
        total = load(b, row + i)
        for j in range(i + 1, n):
            total = total - load(a, i * n + j) * load(b, row + j)
        store(b, row + i, total * load(a, i * n + i))


@nb.njit(forceinline=True)
def _attempt(y, t, h, par, dims, world, extra, nodes, size, tol, w):
    """One RODAS5P step of all lanes: stages to ``k``, the new state to ``y_new``, to ``norm`` the error
    norm, its fifth root and the wall Mach number.

    ``nodes`` chooses the equations: None for those with every option; for the paper's, with their analytic Jacobian, a
    zero per temperature node, and ``size`` a zero per unknown. Only their lengths count. That of a tuple belongs to its
    type: the compiler knows it and unrolls; arrays serve any length.
    """
    work, f, jac, dt, k, stage, y_new, t_stage, norm = w
    mT, mY, mM, wall, q, _, shear = dims
    n = mT + mY + mM + wall + q + 2
    fast_row = n - 2  # V, the only row with an explicit time dependence
    algebraic = mT + mY + mM if nodes is None and wall else -1
    if nodes is None:
        general_jacobian(y, t, par, dims, world, extra, stage, f, y_new, jac, dt)
    else:
        jacobian(y, t, nodes, par, world, work, f, jac, dt)
    step = load(h, 0)
    inverse_h = 1.0 / step
    for i in range(n * n):
        store(jac, i, -load(jac, i))
    for i in range(n):
        if i != algebraic:
            store(jac, i * n + i, load(jac, i * n + i) + inverse_h * (1.0 / _GAMMA))
    _factorise(jac, size)
    now = load(t, 0)
    slope_t = load(dt, 0) * step
    for s in range(_STAGES):
        if s > 0:
            for i in range(n):
                value = load(y, i)
                for r in range(s):
                    value = value + load(k, r * n + i) * _A[s, r]
                store(stage, i, value)
            store(t_stage, 0, now + step * _ALPHA[s])
            if nodes is None:
                general_rhs(stage, t_stage, par, dims, world, extra, f)
            else:
                rhs(stage, t_stage, nodes, par, world, work, f)
        for i in range(n):
            value = splat(0.0)
            if i != algebraic:
                for r in range(s):
                    value = value + load(k, r * n + i) * _C[s, r]
            store(k, s * n + i, load(f, i) + value * inverse_h)
        store(k, s * n + fast_row, load(k, s * n + fast_row) + slope_t * _D[s])
        _solve(jac, size, k, s * n)
    total = splat(0.0)
    last = (_STAGES - 1) * n
    for i in range(n):
        old = load(y, i)
        error = load(k, last + i)
        new = load(stage, i) + error
        store(y_new, i, new)
        size = maximum(absolute(old), absolute(new))
        if shear and i == fast_row:
            # At a bounce V passes the viscosity's knee in 1e-12 µs; on the scale √|V̇| nothing happens.
            size = maximum(size, sqrt(absolute(new - old) * inverse_h))
        ratio = error / (size * tol[1, i] + tol[0, i])
        total = total + ratio * ratio
    error_norm = sqrt(total * (1.0 / n))
    store(norm, 0, error_norm)
    store(norm, 1, exp(log(maximum(error_norm, 1e-8)) * _EXPONENT))
    store(norm, 2, absolute(load(y_new, n - 2)) * exp(load(y_new, n - 1)) * load(par, INVERSE_C))


@nb.njit(forceinline=True)
def _dense(y, y_new, k, n, coefficients):
    """Rows 3n of the dense-output polynomial (K1, K2, K3)."""
    for r in range(3):
        for i in range(n):
            value = splat(0.0)
            for s in range(_STAGES):
                value = value + load(k, s * n + i) * _H[r, s]
            store(coefficients, r * n + i, value)


@nb.njit
def _rows(count):
    """(count, WIDTH) uninitialised, on a 64-byte boundary: a row that straddles two cache lines costs twice."""
    raw = np.empty((count + 1) * WIDTH)
    first = (-(raw.ctypes.data // 8)) % WIDTH
    return raw[first : first + count * WIDTH].reshape(count, WIDTH)


@nb.njit
def _workspace(m, n):
    work, f, jac, dt, k = _rows(6 * m + 2), _rows(n), _rows(n * n), _rows(1), _rows(_STAGES * n)
    return work, f, jac, dt, k, _rows(n), _rows(n), _rows(1), _rows(3)


@nb.njit(cache=True, nogil=True)
def integrate(
    queue, initial, parameters, start, times, dims, law, world, extra, nodes, size, breaks, tol, limits, out, status,
    record,
):  # fmt: skip
    """Integrate N members and write their states at the output times.

    ``queue`` = (counter (1,), available (1,), order (N,)): members are taken in this order; one that is not available
    yet is waited for. Threads that call with the same arrays at once share the members; which of them integrates one
    makes no difference to it.
    initial (N, n), parameters (N, rows), start (N,) µs, times (N, K) increasing µs; ``dims``, ``world`` (without the
    elastic tables) and ``extra`` as for :func:`general.general_rhs`; ``law`` = (samples (N, nodes) of J_e, tabulated
    when a member's turn comes, or (0, nodes); their factor; finished tables (N, cells, 8)); ``nodes`` and ``size`` as
    for :func:`_attempt`; ``tol`` (2, n) absolute and relative tolerances; ``breaks`` increasing instants the steps must
    not straddle; ``limits`` = (first step, longest step inside the driving, step limit, Mach limit, seconds per
    member, τ of the wall above which a breakdown is put down to it). Outputs: out (N, K, n) with NaN where not reached,
    status (N,), record (N, RECORD).
    """
    n_members, n = initial.shape
    n_times = times.shape[1]
    m = dims[0]
    samples, factor, finished = law
    counter, available, order = queue
    ops, espan, drive, dspan, reading = world
    cells = int(espan[3])
    elastic = np.zeros((WIDTH, cells, 8))  # of the members in the lanes: small enough for the cache
    system = (ops, elastic, espan, drive, dspan, reading)
    n_parameters = parameters.shape[1]
    w = _workspace(m, n)
    k, y_new, norm = w[4], w[6], w[8]
    y, t, h, par, coefficients = _rows(n), _rows(1), _rows(1), _rows(n_parameters), _rows(3 * n)
    y[:], t[:], h[:], par[:] = 0.0, 0.0, limits[0], 0.0
    member = np.full(WIDTH, -1, dtype=np.int64)
    observed = np.zeros(WIDTH, dtype=np.int64)
    next_break = np.zeros(WIDTH, dtype=np.int64)
    proposal = np.empty(WIDTH)  # the step before it was cut at a break
    old_h = np.empty(WIDTH)
    old_root = np.empty(WIDTH)
    rejected = np.zeros(WIDTH, dtype=np.bool_)
    waiting = True
    running = 0
    first_step, inside_step, step_limit, mach_limit, seconds, hottest_wall = limits
    began = np.zeros(WIDTH, dtype=np.int64)
    clock = _clock(0)
    attempts = 0

    while True:
        for lane in range(WIDTH):  # refill
            while member[lane] < 0 and waiting:
                turn = take(counter)
                waiting = turn < n_members
                if not waiting:
                    break
                while peek(available) <= turn:
                    pass
                i = order[turn]
                record[i, :] = 0.0
                record[i, MIN_LOG_R] = initial[i, n - 1]
                done = 0
                while done < n_times and times[i, done] <= start[i]:
                    for j in range(n):
                        out[i, done, j] = initial[i, j]
                    done += 1
                for q in range(done, n_times):
                    for j in range(n):
                        out[i, q, j] = np.nan
                status[i] = OK
                record[i, END_TIME] = start[i]
                if done == n_times:
                    continue
                member[lane] = i
                began[lane] = clock
                observed[lane] = done
                for j in range(n):
                    y[j, lane] = initial[i, j]
                for j in range(n_parameters):
                    par[j, lane] = parameters[i, j]
                par[TABLE, lane] = lane * cells * 8
                if samples.shape[0] > 0:
                    fill(samples[i : i + 1], factor, elastic[lane : lane + 1])
                else:
                    elastic[lane] = finished[i]
                t[0, lane] = start[i]
                h[0, lane] = first_step
                old_h[lane] = -1.0
                rejected[lane] = False
                b = 0
                while b < len(breaks) and breaks[b] <= start[i]:
                    b += 1
                next_break[lane] = b
                running += 1
            if member[lane] >= 0:
                now = t[0, lane]
                if par[AMPLITUDE, lane] != 0.0 and dspan[0] <= now < dspan[1] and h[0, lane] > inside_step:
                    h[0, lane] = inside_step
                proposal[lane] = h[0, lane]
                if next_break[lane] < len(breaks) and now + h[0, lane] * 1.0001 >= breaks[next_break[lane]]:
                    h[0, lane] = breaks[next_break[lane]] - now
        if running == 0:
            break
        attempts += 1
        if attempts % _TURNS_PER_LOOK == 0:
            clock = _clock(0)

        _attempt(y, t, h, par, dims, system, extra, nodes, size, tol, w)

        have_dense = False
        for lane in range(WIDTH):
            i = member[lane]
            if i < 0:
                continue
            step = h[0, lane]
            e = norm[0, lane]
            failure = OK
            if not math.isfinite(e):
                rejected[lane] = True
                record[i, REJECTED] += 1
                h[0, lane] = step * 0.1
            else:
                e = max(e, 1e-8)
                root = norm[1, lane]
                shrink = root / _SAFETY
                if e > 1.0:
                    rejected[lane] = True
                    record[i, REJECTED] += 1
                    h[0, lane] = step / min(max(shrink, 1.0 / _GROW), 1.0 / _SHRINK)
                else:
                    now = t[0, lane]
                    cut = next_break[lane] < len(breaks) and now + step >= breaks[next_break[lane]]
                    end = breaks[next_break[lane]] if cut else now + step
                    if cut:
                        next_break[lane] += 1
                    q = observed[lane]
                    while q < n_times and times[i, q] <= end:
                        if not have_dense:
                            _dense(y, y_new, k, n, coefficients)
                            have_dense = True
                        theta = (times[i, q] - now) / step
                        rest = 1.0 - theta
                        for j in range(n):
                            bend = coefficients[n + j, lane] + theta * coefficients[2 * n + j, lane]
                            bend = coefficients[j, lane] + theta * bend
                            out[i, q, j] = rest * y[j, lane] + theta * (y_new[j, lane] + rest * bend)
                        q += 1
                    observed[lane] = q
                    for j in range(n):
                        y[j, lane] = y_new[j, lane]
                    t[0, lane] = end
                    record[i, STEPS] += 1
                    record[i, END_TIME] = end
                    log_r = y[n - 1, lane]
                    mach = norm[2, lane]
                    record[i, MAX_MACH] = max(record[i, MAX_MACH], mach)
                    record[i, MIN_LOG_R] = min(record[i, MIN_LOG_R], log_r)
                    if m > 0:
                        record[i, MAX_THETA] = max(record[i, MAX_THETA], y[0, lane])
                    # Gustafsson's predictive controller: the trend of the error, not only its size, sets the next step.
                    if old_h[lane] > 0.0:
                        trend = old_h[lane] / step * root * root / old_root[lane] / _SAFETY
                        shrink = max(shrink, trend)
                    grown = step / min(max(shrink, 1.0 / _GROW), 1.0 / _SHRINK)
                    if rejected[lane]:
                        grown = min(grown, step)
                    if cut and grown < proposal[lane] and e < 1.0:
                        grown = max(grown, min(proposal[lane], step * _GROW))
                    old_h[lane] = step
                    old_root[lane] = max(root, _LEAST_ROOT)
                    rejected[lane] = False
                    h[0, lane] = grown
                    if mach > mach_limit:
                        failure = MACH_LIMIT
            if record[i, STEPS] + record[i, REJECTED] >= step_limit:
                failure = STEP_LIMIT
            if clock - began[lane] > seconds + 1.0:  # the clock ticks in seconds
                failure = TIME_LIMIT
            if h[0, lane] < _SHORTEST:
                failure = STEP_UNDERFLOW if math.isfinite(norm[0, lane]) else NON_FINITE
                if dims[3] > 0 and y[dims[0] + dims[1] + dims[2], lane] > hottest_wall:
                    failure = WALL_LIMIT
            if failure != OK or observed[lane] == n_times:
                status[i] = failure
                member[lane] = -1
                h[0, lane] = first_step
                running -= 1
