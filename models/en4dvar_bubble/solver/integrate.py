"""Adaptive integration of many members: eight lanes, each with its own member, time and step, refilled when one
finishes.
"""

from __future__ import annotations

import math

import numba as nb
from numba.core import types

from en4dvar.compiled import kernel_without_allocation
from en4dvar_bubble.solver import rodas5p
from en4dvar_bubble.solver.arrays import Lanes, Loaded, Workspace
from en4dvar_bubble.solver.lanes import WIDTH, peek, rows_of, take
from en4dvar_bubble.solver.rows import AMPLITUDE, PULSE_RATE, PULSE_SHIFT, TABLE
from en4dvar_bubble.solver.step import LEAST_ERROR, attempt, interpolant
from en4dvar_bubble.tables import fill

# Status of a member; the reasons users read are made by ``driver.reason``.
OK, STEP_LIMIT, NON_FINITE, STEP_UNDERFLOW, MACH_LIMIT, TIME_LIMIT, WALL_LIMIT = 0, 1, 2, 3, 4, 5, 6
# Columns of the per-member record.
STEPS, REJECTED, MAX_MACH, MAX_THETA, MIN_LOG_R, END_TIME, BEYOND = 0, 1, 2, 3, 4, 5, 6
RECORD = 7

_SAFETY, _SHRINK, _GROW = 0.9, 0.15, 6.0
_LEAST_ROOT = 1e-2 ** (1.0 / rodas5p.ORDER)
# µs. A bounce may need steps below the spacing of doubles near t: the equations know no other time by then, and the
# step limit bounds the work.
_SHORTEST = 1e-18
_TURNS_PER_LOOK = 64  # attempted steps between looks at the clock

_clock = types.ExternalFunction("time", types.int64(types.intp))  # time(NULL) of the C library, seconds


@nb.njit(inline="always")
def _workspace(block, at):
    """The first rows of the block, parted at ``at``."""
    return Workspace(
        rows_of(block, at[0], at[1]),
        rows_of(block, at[1], at[2]),
        rows_of(block, at[2], at[3]),
        rows_of(block, at[3], at[4]),
        rows_of(block, at[4], at[5]),
        rows_of(block, at[5], at[6]),
        rows_of(block, at[6], at[7]),
        rows_of(block, at[7], at[8]),
        rows_of(block, at[8], at[9]),
        rows_of(block, at[9], at[10]),
        rows_of(block, at[10], at[11]),
        rows_of(block, at[11], at[12]),
        rows_of(block, at[12], at[13]),
        rows_of(block, at[13], at[14]),
        rows_of(block, at[14], at[15]),
        rows_of(block, at[15], at[16]),
        rows_of(block, at[16], at[17]),
    )


@nb.njit(inline="always")
def _idle_lanes(block, at, marks, elastic, step):
    """The last rows of the block, parted at ``at``, and the marks."""
    y, t, h = rows_of(block, at[0], at[1]), rows_of(block, at[1], at[2]), rows_of(block, at[2], at[3])
    loaded = Loaded(rows_of(block, at[3], at[4]), elastic)
    proposed, last_h = rows_of(block, at[4], at[5]), rows_of(block, at[5], at[6])
    last_root, rejected = rows_of(block, at[6], at[7]), rows_of(block, at[7], at[8])
    member, began = rows_of(marks, 0, 1), rows_of(marks, 1, 2)
    observed, next_break = rows_of(marks, 2, 3), rows_of(marks, 3, 4)
    for lane in range(WIDTH):
        h[0, lane] = step
        member[lane] = -1
    return Lanes(y, t, h, loaded, member, began, observed, next_break, proposed, last_h, last_root, rejected)


@nb.njit
def _begin(i, lane, clock, members, lanes, control, out):
    """Put member ``i`` into a lane; 1, or 0 where no output time lies after its start."""
    n, n_times, start = len(lanes.y), members.times.shape[1], members.start[i]
    out.record[i, :] = 0.0
    out.record[i, MIN_LOG_R] = members.initial[i, n - 1]
    out.record[i, END_TIME] = start
    out.record[i, BEYOND] = math.inf
    out.status[i] = OK
    done = 0
    while done < n_times and members.times[i, done] <= start:
        done += 1
    for q in range(n_times):
        for j in range(n):
            out.states[i, q, j] = members.initial[i, j] if q < done else math.nan
    if done == n_times:
        return 0
    lanes.member[lane], lanes.began[lane], lanes.observed[lane] = i, clock, done
    par, elastic = lanes.loaded.par, lanes.loaded.elastic
    for j in range(n):
        lanes.y[j, lane] = members.initial[i, j]
    for j in range(len(par)):
        par[j, lane] = members.parameters[i, j]
    par[TABLE, lane] = lane * elastic.shape[1] * 8
    if members.samples.shape[0] > 0:
        fill(members.samples[i : i + 1], members.factor, elastic[lane : lane + 1])
    else:
        for cell in range(elastic.shape[1]):
            for j in range(8):
                elastic[lane, cell, j] = members.tables[i, cell, j]
    lanes.t[0, lane], lanes.h[0, lane] = start, control.first_step
    lanes.last_h[lane], lanes.rejected[lane] = -1.0, 0.0
    b = 0
    while b < len(control.breaks) and _break(b, lane, lanes, control) <= start:
        b += 1
    lanes.next_break[lane] = b
    return 1


@nb.njit(inline="always")
def _break(b, lane, lanes, control):
    """The instant of a break on the clock of the lane's member."""
    return control.breaks[b] / lanes.loaded.par[PULSE_RATE, lane] + lanes.loaded.par[PULSE_SHIFT, lane]


@nb.njit(inline="always")
def _cut_step(lane, lanes, eq, control):
    """Shorten a lane's step while the driving acts, and to end at a break."""
    h, now, span, par = lanes.h, lanes.t[0, lane], eq.driving_span, lanes.loaded.par
    rate, b = par[PULSE_RATE, lane], lanes.next_break[lane]
    driven = par[AMPLITUDE, lane] != 0.0 and span[0] <= (now - par[PULSE_SHIFT, lane]) * rate < span[1]
    if driven and h[0, lane] > control.longest_driven / rate:
        h[0, lane] = control.longest_driven / rate
    lanes.proposed[lane] = h[0, lane]
    if b < len(control.breaks):
        end = _break(b, lane, lanes, control)
        if now + h[0, lane] * 1.0001 >= end:
            h[0, lane] = end - now


@nb.njit(inline="always")
def _observe(lane, end, members, lanes, w, have_dense, out):
    """Write a lane's state at the output times until ``end``; whether the interpolant has been made."""
    i, q, y = lanes.member[lane], lanes.observed[lane], lanes.y
    times, n = members.times[i], len(y)
    while q < len(times) and times[q] <= end:
        if not have_dense:
            interpolant(w)
            have_dense = True
        theta = (times[q] - lanes.t[0, lane]) / lanes.h[0, lane]
        rest = 1.0 - theta
        for j in range(n):
            bend = w.dense[n + j, lane] + theta * w.dense[2 * n + j, lane]
            bend = w.dense[j, lane] + theta * bend
            out.states[i, q, j] = rest * y[j, lane] + theta * (w.y_new[j, lane] + rest * bend)
        q += 1
    lanes.observed[lane] = q
    return have_dense


@nb.njit(inline="always")
def _next_step(lane, cut, lanes, w):
    """The step after an accepted one, by Gustafsson's predictive controller: the trend of the error, not only its size,
    sets it.
    """
    step, e, root = lanes.h[0, lane], max(w.norm[0, lane], LEAST_ERROR), w.norm[1, lane]
    shrink = root / _SAFETY
    if lanes.last_h[lane] > 0.0:
        trend = lanes.last_h[lane] / step * root * root / lanes.last_root[lane] / _SAFETY
        shrink = max(shrink, trend)
    grown = step / min(max(shrink, 1.0 / _GROW), 1.0 / _SHRINK)
    if lanes.rejected[lane] > 0.0:
        grown = min(grown, step)
    if cut and grown < lanes.proposed[lane] and e < 1.0:
        grown = max(grown, min(lanes.proposed[lane], step * _GROW))
    return grown


@nb.njit(inline="always")
def _accept(lane, members, lanes, eq, control, w, have_dense, out):
    """Take a lane's step: outputs, state, record, next step; whether the interpolant has been made."""
    i, now, step = lanes.member[lane], lanes.t[0, lane], lanes.h[0, lane]
    b = lanes.next_break[lane]
    cut, end = False, now + step
    if b < len(control.breaks) and end >= _break(b, lane, lanes, control):
        cut, end = True, _break(b, lane, lanes, control)
        lanes.next_break[lane] += 1
    have_dense = _observe(lane, end, members, lanes, w, have_dense, out)
    for j in range(len(lanes.y)):
        lanes.y[j, lane] = w.y_new[j, lane]
    lanes.t[0, lane] = end
    record = out.record[i]
    record[STEPS] += 1
    record[END_TIME] = end
    record[MAX_MACH] = max(record[MAX_MACH], w.norm[2, lane])
    if w.norm[2, lane] > control.valid_mach:
        record[BEYOND] = min(record[BEYOND], now)
    record[MIN_LOG_R] = min(record[MIN_LOG_R], lanes.y[len(lanes.y) - 1, lane])
    if eq.dims.gas > 0:
        record[MAX_THETA] = max(record[MAX_THETA], lanes.y[0, lane])
    lanes.h[0, lane] = _next_step(lane, cut, lanes, w)
    lanes.last_h[lane], lanes.last_root[lane] = step, max(w.norm[1, lane], _LEAST_ROOT)
    lanes.rejected[lane] = 0.0
    return have_dense


@nb.njit(inline="always")
def _reject(lane, lanes, w, out):
    """Shorten a lane's step."""
    lanes.rejected[lane] = 1.0
    out.record[lanes.member[lane], REJECTED] += 1
    if math.isfinite(w.norm[0, lane]):
        lanes.h[0, lane] = lanes.h[0, lane] / min(max(w.norm[1, lane] / _SAFETY, 1.0 / _GROW), 1.0 / _SHRINK)
    else:
        lanes.h[0, lane] = lanes.h[0, lane] * 0.1


@nb.njit(inline="always")
def _failure(lane, clock, lanes, eq, control, w, out):
    """Why a lane's member cannot go on; OK where it can."""
    failure, dims = OK, eq.dims
    if lanes.rejected[lane] == 0.0 and w.norm[2, lane] > control.mach_limit:
        failure = MACH_LIMIT
    record = out.record[lanes.member[lane]]
    if record[STEPS] + record[REJECTED] >= control.step_limit:
        failure = STEP_LIMIT
    if clock - lanes.began[lane] > control.seconds + 1.0:  # the clock ticks in seconds
        failure = TIME_LIMIT
    if lanes.h[0, lane] < _SHORTEST:
        failure = STEP_UNDERFLOW if math.isfinite(w.norm[0, lane]) else NON_FINITE
        if dims.wall > 0 and lanes.y[dims.gas + dims.vapour + dims.medium, lane] > control.hottest_wall:
            failure = WALL_LIMIT
    return failure


@kernel_without_allocation
def integrate(members, eq, control, out, scratch):
    """Integrate all members and write their states at the output times: refill the lanes, step, look at every lane,
    until no member is left. The arguments are those of :mod:`arrays`.
    """
    w = _workspace(scratch.block, scratch.edges)
    lanes = _idle_lanes(scratch.block, scratch.edges[len(w) :], scratch.marks, scratch.elastic, control.first_step)
    n_times = members.times.shape[1]
    waiting, running, attempts, clock = True, 0, 0, _clock(0)
    while True:
        for lane in range(WIDTH):
            while lanes.member[lane] < 0 and waiting:
                turn = take(members.counter)
                waiting = turn < len(members.order)
                if waiting:
                    while peek(members.available) <= turn:
                        pass
                    running += _begin(members.order[turn], lane, clock, members, lanes, control, out)
            if lanes.member[lane] >= 0:
                _cut_step(lane, lanes, eq, control)
        if running == 0:
            break
        attempts += 1
        if attempts % _TURNS_PER_LOOK == 0:
            clock = _clock(0)

        attempt(lanes, eq, control.tolerances, w)

        have_dense = False
        for lane in range(WIDTH):
            i = lanes.member[lane]
            if i < 0:
                continue
            if w.norm[0, lane] <= 1.0:  # false for NaN
                have_dense = _accept(lane, members, lanes, eq, control, w, have_dense, out)
            else:
                _reject(lane, lanes, w, out)
            failure = _failure(lane, clock, lanes, eq, control, w, out)
            if failure != OK or lanes.observed[lane] == n_times:
                out.status[i] = failure
                lanes.member[lane] = -1
                lanes.h[0, lane] = control.first_step
                running -= 1
