"""Smooth functions in the kernel: piecewise quintics, see :mod:`en4dvar_bubble.tables`."""

from en4dvar.plumbing.compiled import inlined
from en4dvar_bubble.solver.lanes import any_lane, floor, gather_rows, load, maximum, minimum, select, splat
from en4dvar_bubble.solver.rows import AMPLITUDE, PULSE_RATE, PULSE_SHIFT, PULSE_TABLE


@inlined
def lookup(table, offset, span, x):
    """Value, first and second derivative of a piecewise quintic; beyond its ends the last interval is extended.

    A cell whose eighth number is not zero is halved: the number is the place of its left half, the right one follows.
    """
    origin, intervals = span[0], span[3]
    per_unit = splat(span[2])
    position = (x - origin) * per_unit
    cell = minimum(maximum(floor(position), 0.0), intervals - 1.0)
    s = position - cell
    at = offset + cell * 8.0
    for _ in range(int(span[4])):
        half = gather_rows(table, at + 2.0)[5]
        halved = half > 0.5
        if not any_lane(halved):
            break
        right = select(s < 0.5, 0.0, 1.0)
        at = select(halved, offset + (half + right) * 8.0, at)
        s = select(halved, s * 2.0 - right, s)
        per_unit = select(halved, per_unit * 2.0, per_unit)
    c0, c1, c2, c3, c4, c5 = gather_rows(table, at)
    value = ((((c5 * s + c4) * s + c3) * s + c2) * s + c1) * s + c0
    first = (((c5 * 5.0 * s + c4 * 4.0) * s + c3 * 3.0) * s + c2 * 2.0) * s + c1
    second = ((c5 * 20.0 * s + c4 * 12.0) * s + c3 * 6.0) * s + c2 * 2.0
    return value, first * per_unit, second * (per_unit * per_unit)


@inlined
def driving(t, eq, par):
    """p_f, dp_f/dt, d²p_f/dt² at the lanes' times; zero outside the table's span."""
    zero, span, rate = splat(0.0), eq.driving_span, load(par, PULSE_RATE)
    read = (t - load(par, PULSE_SHIFT)) * rate
    before = read < span[0]
    after = read > span[1]
    inside = select(before, 0.0, select(after, 0.0, 1.0))
    if not any_lane(inside > 0.5):
        return zero, zero, zero
    f, g, h = lookup(eq.driving, load(par, PULSE_TABLE), span, read)
    scale = load(par, AMPLITUDE) * inside
    return f * scale, g * rate * scale, h * rate * rate * scale
