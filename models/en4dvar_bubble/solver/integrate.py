"""Adaptive integration of many members: eight lanes, each with its own member, time and step, refilled when one
finishes.
"""

import math

import numba as nb
import numpy as np
from numba.core import types

from en4dvar.plumbing.compiled import called, kernel_called_by_address, kernel_without_allocation
from en4dvar_bubble.solver import rodas5p
from en4dvar_bubble.solver.apart import call, kept
from en4dvar_bubble.solver.arrays import Lanes, Loaded, Workspace
from en4dvar_bubble.solver.lanes import WIDTH, parted, take
from en4dvar_bubble.solver.rows import AMPLITUDE, PULSE_RATE, PULSE_SHIFT, SMEARED, TABLE
from en4dvar_bubble.solver.step import LEAST_ERROR, attempt, interpolant, judge
from en4dvar_bubble.tables import fill_one

# Status of a member; the reasons users read are made by ``driver.Solution``.
OK, STEP_LIMIT, NON_FINITE, STEP_UNDERFLOW, MACH_LIMIT, TIME_LIMIT, WALL_LIMIT = 0, 1, 2, 3, 4, 5, 6
# Columns of the per-member record: steps, rejected ones, largest wall Mach number, largest τ at the innermost node,
# smallest ln(R/µm), end time (µs), since when (µs) the wall is faster than the equations bear, numerical diffusivity of
# the vapour over R |Ṙ| (0 but for violent collapses); when a hundredth of the span began (µs), steps up to then.
STEPS, REJECTED, MAX_MACH, MAX_THETA, MIN_LOG_R, END_TIME, BEYOND, SMEAR, MARK, TO_MARK = 0, 1, 2, 3, 4, 5, 6, 7, 8, 9
RECORD = 10

_SAFETY, _SHRINK, _GROW = 0.9, 0.15, 6.0
_LEAST_ROOT = 1e-2 ** (1.0 / rodas5p.ORDER)
# µs. A bounce may need steps below the spacing of doubles near t: the equations know no other time by then, and the
# step limit bounds the work.
_SHORTEST = 1e-18
# Of the step limit, what a hundredth of the span may take: a member that has stalled in a collapse will not leave it.
_STALLED, _HUNDREDTH = 0.3, 0.01
_LEAST_SMEARED, _MOST_SMEARED = 0.001, 0.5  # each time four times the last
_TURNS_PER_LOOK = 64  # attempted steps between looks at the clock
# Of ``turn``: how many so far, lanes with a member, whether all are taken, seconds so far, whether the interpolant is
# made, and the time of day at the last look.
_TURNS, _RUNNING, _EXHAUSTED, _CLOCK, _DENSE, _SEEN = range(6)
_MOST_BETWEEN = 2  # s between looks that count: in a longer time the process was suspended (Ctrl-Z)
_MARKS = np.arange(5)  # the edges of the marks
_OF_STEP, _PARTS = len(Workspace._fields), len(Workspace._fields) + 8

_clock = types.ExternalFunction("time", types.int64(types.intp))  # time(NULL) of the C library, seconds


@nb.njit(inline="always")
def groups(scratch):
    """The parts of a thread's scratch: the workspace and the lanes."""
    f = parted(scratch.block, scratch.edges, _PARTS)
    m = parted(scratch.marks, _MARKS, 4)
    w = Workspace(*f[:_OF_STEP])
    y, t, h, par, proposed, last_h, last_root, rejected = f[_OF_STEP:]
    loaded = Loaded(par, scratch.elastic)
    return w, Lanes(y, t, h, loaded, m[0], m[1], m[2], m[3], proposed, last_h, last_root, rejected)


@called
def _begin(i, lane, shared, lanes):
    """Put member ``i`` into a lane; 1, or 0 where no output time lies after its start."""
    members, control, out, clock = shared.members, shared.control, shared.out, shared.scratch.turn[_CLOCK]
    n, n_times, start = len(lanes.y), members.times.shape[1], members.start[i]
    for column in range(RECORD):
        out.record[i, column] = 0.0
    out.record[i, MIN_LOG_R] = members.initial[i, n - 1]
    out.record[i, END_TIME] = out.record[i, MARK] = start
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
        fill_one(members.samples, i, members.factor, elastic, lane)
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


@called
def _break(b, lane, lanes, control):
    """The instant of a break on the clock of the lane's member."""
    return control.breaks[b] / lanes.loaded.par[PULSE_RATE, lane] + lanes.loaded.par[PULSE_SHIFT, lane]


@called
def _cut_step(lane, shared, lanes):
    """Shorten a lane's step while the driving acts, and to end at a break."""
    control, span = shared.control, shared.driving_span
    h, now, par = lanes.h, lanes.t[0, lane], lanes.loaded.par
    rate, b = par[PULSE_RATE, lane], lanes.next_break[lane]
    driven = par[AMPLITUDE, lane] != 0.0 and span[0] <= (now - par[PULSE_SHIFT, lane]) * rate < span[1]
    if driven and h[0, lane] > control.longest_driven / rate:
        h[0, lane] = control.longest_driven / rate
    lanes.proposed[lane] = h[0, lane]
    if b < len(control.breaks):
        end = _break(b, lane, lanes, control)
        if now + h[0, lane] * 1.0001 >= end:
            h[0, lane] = end - now


@called
def _observe(lane, end, shared, lanes, w):
    """Write a lane's state at the output times until ``end``."""
    members, out, turn = shared.members, shared.out, shared.scratch.turn
    i, q, y = lanes.member[lane], lanes.observed[lane], lanes.y
    times, n = members.times, len(y)
    while q < times.shape[1] and times[i, q] <= end:
        if turn[_DENSE] == 0:
            interpolant(w)
            turn[_DENSE] = 1
        theta = (times[i, q] - lanes.t[0, lane]) / lanes.h[0, lane]
        rest = 1.0 - theta
        for j in range(n):
            bend = w.dense[n + j, lane] + theta * w.dense[2 * n + j, lane]
            bend = w.dense[j, lane] + theta * bend
            out.states[i, q, j] = rest * y[j, lane] + theta * (w.y_new[j, lane] + rest * bend)
        q += 1
    lanes.observed[lane] = q


@called
def _next_step(lane, cut, lanes, w):
    """The step after an accepted one, by the error's size and trend (Gustafsson's predictive controller)."""
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


@called
def _accept(lane, shared, lanes, w):
    """Take a lane's step: outputs, state, record, next step."""
    control, dims, out = shared.control, shared.dims, shared.out
    i, now, step = lanes.member[lane], lanes.t[0, lane], lanes.h[0, lane]
    b = lanes.next_break[lane]
    cut, end = False, now + step
    if b < len(control.breaks) and end >= _break(b, lane, lanes, control):
        cut, end = True, _break(b, lane, lanes, control)
        lanes.next_break[lane] += 1
    _observe(lane, end, shared, lanes, w)
    for j in range(len(lanes.y)):
        lanes.y[j, lane] = w.y_new[j, lane]
    lanes.t[0, lane] = end
    record = out.record
    record[i, STEPS] += 1
    record[i, END_TIME] = end
    times = shared.members.times
    if end - record[i, MARK] > _HUNDREDTH * (times[i, times.shape[1] - 1] - shared.members.start[i]):
        record[i, MARK], record[i, TO_MARK] = end, record[i, STEPS] + record[i, REJECTED]
    record[i, MAX_MACH] = max(record[i, MAX_MACH], w.norm[2, lane])
    if w.norm[2, lane] > control.valid_mach:
        record[i, BEYOND] = min(record[i, BEYOND], now)
    record[i, MIN_LOG_R] = min(record[i, MIN_LOG_R], lanes.y[len(lanes.y) - 1, lane])
    if dims.gas > 0:
        record[i, MAX_THETA] = max(record[i, MAX_THETA], lanes.y[0, lane])
    lanes.h[0, lane] = _next_step(lane, cut, lanes, w)
    lanes.last_h[lane], lanes.last_root[lane] = step, max(w.norm[1, lane], _LEAST_ROOT)
    lanes.rejected[lane] = 0.0


@called
def _reject(lane, shared, lanes, w):
    lanes.rejected[lane] = 1.0
    shared.out.record[lanes.member[lane], REJECTED] += 1
    if math.isfinite(w.norm[0, lane]):
        lanes.h[0, lane] = lanes.h[0, lane] / min(max(w.norm[1, lane] / _SAFETY, 1.0 / _GROW), 1.0 / _SHRINK)
    else:
        lanes.h[0, lane] = lanes.h[0, lane] * 0.1


@called
def _failure(lane, shared, lanes, w):
    """Why a lane's member cannot go on; OK where it can."""
    control, dims, out, clock = shared.control, shared.dims, shared.out, shared.scratch.turn[_CLOCK]
    failure = OK
    if lanes.rejected[lane] == 0.0 and w.norm[2, lane] > control.mach_limit:
        failure = MACH_LIMIT
    record, i = out.record, lanes.member[lane]
    taken = record[i, STEPS] + record[i, REJECTED]
    if taken >= control.step_limit or taken - record[i, TO_MARK] >= _STALLED * control.step_limit:
        failure = STEP_LIMIT
    if clock - lanes.began[lane] > control.seconds + 1.0:  # the clock ticks in seconds
        failure = TIME_LIMIT
    if lanes.h[0, lane] < _SHORTEST:
        failure = STEP_UNDERFLOW if math.isfinite(w.norm[0, lane]) else NON_FINITE
        if dims.wall > 0 and lanes.y[dims.gas + dims.vapour + dims.medium, lane] > control.hottest_wall:
            failure = WALL_LIMIT
    return failure


@called
def _again(lane, shared, lanes):
    """Whether a member begins again, with its vapour smeared: where it condenses faster than it diffuses, the gas left
    behind is a layer at the wall of thickness D/|Ṙ|. A grid that cannot hold it gives fractions below zero, for which
    the equations have no solution. A diffusivity of at least ``SMEARED`` · R |Ṙ| makes the layer that part of R.
    """
    smeared, began = lanes.loaded.par[SMEARED, lane], lanes.began[lane]
    if shared.dims.vapour == 0 or smeared > _MOST_SMEARED:
        return False
    _begin(lanes.member[lane], lane, shared, lanes)
    lanes.loaded.par[SMEARED, lane] = max(_LEAST_SMEARED, 4.0 * smeared)
    shared.out.record[lanes.member[lane], SMEAR] = lanes.loaded.par[SMEARED, lane]
    lanes.began[lane] = began
    return True


@called
def _end_step(shared, lanes, w):
    """Look at every lane after a step: take it or shorten it, and let go of members that are done or cannot go on."""
    members, control, turn = shared.members, shared.control, shared.scratch.turn
    judge(lanes, shared.dims.shear, control.tolerances, w)
    turn[_DENSE] = 0
    for lane in range(WIDTH):
        i = lanes.member[lane]
        if i < 0:
            continue
        if w.norm[0, lane] <= 1.0:  # false for NaN
            _accept(lane, shared, lanes, w)
        else:
            _reject(lane, shared, lanes, w)
        failure = _failure(lane, shared, lanes, w)
        if failure in (NON_FINITE, STEP_UNDERFLOW) and _again(lane, shared, lanes):
            continue
        if failure != OK or lanes.observed[lane] == members.times.shape[1]:
            shared.out.status[i] = failure
            lanes.member[lane] = -1
            lanes.h[0, lane] = control.first_step
            turn[_RUNNING] -= 1


@called
def _begin_step(shared, lanes):
    """Give idle lanes a member while there is one, and every lane its step."""
    members, turn = shared.members, shared.scratch.turn
    for lane in range(WIDTH):
        while lanes.member[lane] < 0 and turn[_EXHAUSTED] == 0:
            place = take(members.counter)
            if place >= len(members.order):
                turn[_EXHAUSTED] = 1
            else:
                turn[_RUNNING] += _begin(members.order[place], lane, shared, lanes)
        if lanes.member[lane] >= 0:
            _cut_step(lane, shared, lanes)


@kernel_called_by_address
def between_steps(shared):
    """What is done between two steps, of which the first has nothing before it, for the :class:`Shared` kept there: how
    many lanes have a member.
    """
    workspace, group = groups(shared.scratch)
    w, lanes, turn = kept(workspace), kept(group), shared.scratch.turn
    if turn[_TURNS] % _TURNS_PER_LOOK == 0:
        now = _clock(0)
        if turn[_TURNS] > 0:
            turn[_CLOCK] += min(now - turn[_SEEN], _MOST_BETWEEN)
        turn[_SEEN] = now
    if turn[_TURNS] > 0:
        _end_step(shared, lanes, w)
    turn[_TURNS] += 1
    _begin_step(shared, lanes)
    return turn[_RUNNING]


@kernel_without_allocation
def integrate(between, shared, eq):
    """Integrate all members and write their states at the output times. ``between`` is where the machine code of
    :func:`between_steps` is; the other arguments are those of :mod:`arrays`.
    """
    w, lanes = groups(shared.scratch)
    place = kept(shared)
    while call(between, place) > 0:
        attempt(lanes, eq, w)
