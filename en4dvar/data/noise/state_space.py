r"""Whitening beside a discrepancy in O(K): its process in state-space form, filtered along the readings.

A Matérn process of smoothness p + ½ is the first component of a linear system (f, f'/λ, …)ᵀ of p + 1 states,
λ = √(2p + 1)/ℓ, with transition e^{−λΔ} times a polynomial in λΔ and the stationary covariance P_∞. Kalman's filter of
y_k − m_k = a_k f(t_k) + ε_k gives what is new in each reading, v_k, and its standard deviation L_kk: the numbers of
the Cholesky factor of R + A, which takes K³/3 operations.

With Huber's loss for ε the mode of f is had by the same filter and its adjoint, the disturbance smoother: a reading
in the tails pulls with the constant force c/s, which moves the mean and leaves the covariance as it is.

Source: Hartikainen & Särkkä (2010), Proc. IEEE MLSP, 379; Särkkä & Solin (2019), Applied Stochastic Differential
Equations, § 12.3; Durbin & Koopman (2012), Time Series Analysis by State Space Methods, § 4.5.
"""

import numpy as np
import numpy.typing as npt

from en4dvar.model.state import Array
from en4dvar.plumbing.compiled import called, kernel


def innovations(residuals: Array, errors: Array, amplitudes: Array, lengths: Array, steps: Array, nu: float) -> Array:
    """v and the diagonal of L (2, B, K) of B runs; NaN where R + A is singular to rounding, as a dense factor would be.

    Parameters
    ----------
    residuals: (B, K) y − m. errors: (B, K) variances of ε. amplitudes: (B, K) a g.
    lengths: (B,) ℓ. steps: (K − 1,) > 0 between readings. nu: ½, 3/2 or 5/2.
    """
    with np.errstate(all="ignore"):
        rates = np.sqrt(2 * nu) / lengths
        least = steps.min(initial=np.inf)  # those of a camera are equal but for rounding
        different, which = np.unique(np.round(steps / least, 12), return_inverse=True)
        d = np.outer(different * least, rates)
        shrink = np.exp(-d)
    r, e, a = (np.ascontiguousarray(part.T, dtype=float) for part in (residuals, errors, amplitudes))
    white = np.empty((2, *r.shape))
    _filter(int(nu + 0.5), r, e, a, d, shrink, which, white)
    with np.errstate(all="ignore"):
        rounding = 4 * len(r) * np.finfo(float).eps * np.square(a).max(axis=0)
        singular = np.square(white[1]).min(axis=0) < rounding
    white[:, :, singular] = np.nan
    return np.ascontiguousarray(white.transpose(0, 2, 1))


ABREAST = 128  # runs that are filtered side by side: the inner loops are over runs, as the vector units like them


@kernel
def _filter(
    order: int,
    residuals: Array,
    errors: Array,
    amplitudes: Array,
    d: Array,
    shrink: Array,
    which: npt.NDArray[np.intp],
    white: Array,
) -> None:
    """``white`` (2, K, B). Runs are last in all arrays; d = λΔ and e^{−d} (U, B) are of each different step, ``which``
    (K − 1,) says of which each is.
    """
    stationary = _stationary(order)
    move, half = np.empty((order, order, ABREAST)), np.empty((order, order, ABREAST))
    apart = np.empty((order, order, ABREAST))  # P − P_∞
    mean, column = np.empty((order, ABREAST)), np.empty((order, ABREAST))
    count, runs = residuals.shape
    for first in range(0, runs, ABREAST):
        n = min(ABREAST, runs - first)
        some = slice(first, first + n)
        mean[:], apart[:] = 0.0, 0.0
        for k in range(count):
            if k > 0:
                if k == 1 or which[k - 1] != which[k - 2]:
                    _set_transitions(order, d[which[k - 1], some], shrink[which[k - 1], some], move)
                _advance_abreast(order, n, move, mean, apart, column, half)
            r, e, a = residuals[k, some], errors[k, some], amplitudes[k, some]
            new, root = white[0, k, some], white[1, k, some]
            for run in range(n):
                variance = a[run] * a[run] * (stationary[0, 0] + apart[0, 0, run]) + e[run]
                root[run] = np.sqrt(variance if variance > 0.0 else np.nan)
                new[run] = (r[run] - a[run] * mean[0, run]) / root[run]
            for i in range(order):
                for run in range(n):
                    column[i, run] = a[run] * (stationary[i, 0] + apart[i, 0, run]) / root[run]
            for i in range(order):
                for run in range(n):
                    mean[i, run] += column[i, run] * new[run]
                for j in range(order):
                    for run in range(n):
                        apart[i, j, run] -= column[i, run] * column[j, run]


@called
def _advance_abreast(order: int, n: int, move: Array, mean: Array, apart: Array, column: Array, half: Array) -> None:
    """:func:`_advance` of the first n runs, each by its own ``move``."""
    for i in range(order):
        column[i] = 0.0
        for j in range(order):
            half[i, j] = 0.0
            for run in range(n):
                column[i, run] += move[i, j, run] * mean[j, run]
            for m in range(order):
                for run in range(n):
                    half[i, j, run] += move[i, m, run] * apart[m, j, run]
    mean[:] = column
    for i in range(order):
        for j in range(order):
            apart[i, j] = 0.0
            for m in range(order):
                for run in range(n):
                    apart[i, j, run] += half[i, m, run] * move[j, m, run]


def boxed(
    residuals: Array, std: Array, own: Array, amplitudes: Array, lengths: Array, steps: Array, nu: float, c: float
) -> Array:
    """u = ρ'(ε/s)/s and δ (2, B, K) of B runs at the mode of Huber's loss and the process; NaN where r is not finite.

    Parameters
    ----------
    residuals: (B, K) y − m. std: (B, K) s of ε. own: (B, K) variances of what in δ each reading has of its own.
    amplitudes: (B, K) a g. lengths: (B,) ℓ. steps: (K − 1,) > 0 between readings. nu: ½, 3/2 or 5/2. c: threshold.
    """
    mode = np.empty((2, *residuals.shape))
    with np.errstate(all="ignore"):
        rates = np.sqrt(2 * nu) / lengths
    r, s, nuggets, a, rates, steps = (
        np.ascontiguousarray(part, dtype=float) for part in (residuals, std, own, amplitudes, rates, steps)
    )
    _boxed((0.0,) * int(nu + 0.5), r, s, nuggets, a, rates, steps, c, mode)
    return mode


States = tuple[float, ...]  # one number for each state of the process: the compiler knows how many
SETTLED = 1e-10  # of the slope of J at the end of a step, against that at its begin
NEWTON, SECANTS = 200, 50  # iterations, and those for the length of a step


@kernel
def _boxed(
    states: States,
    residuals: Array,
    std: Array,
    own: Array,
    amplitudes: Array,
    rates: Array,
    steps: Array,
    c: float,
    mode: Array,
) -> None:
    """``mode`` (2, B, K), run by run: Newton's method on which readings are in the tails, each step as long as J falls.

    The first step is to the mode of Gaussian errors. J is convex and quadratic in pieces, so that this ends; whole
    steps may go round in circles.
    """
    order = len(states)
    count = residuals.shape[1]
    force, at, pull = np.empty(count), np.empty(count), np.empty(count)
    moves, towards = np.empty((count - 1, order, order)), np.empty((count, order))
    expected, precision = np.empty(count), np.empty(count)
    room = np.empty((2 * order + 2, order))
    for run in range(residuals.shape[0]):
        r, s, nugget, a, u, delta = (
            residuals[run], std[run], own[run], amplitudes[run], mode[0, run], mode[1, run],
        )  # fmt: skip
        if not np.isfinite(np.sum(r) + np.sum(s) + np.sum(a) + rates[run]):
            mode[:, run] = np.nan
            continue
        _set_transitions(order, rates[run] * steps, np.exp(-rates[run] * steps), moves.transpose((1, 2, 0)))
        at[:], pull[:], force[:] = 0.0, 0.0, np.nan
        for _ in range(NEWTON):
            _ahead(states, r, s, nugget, force, a, moves, u, expected, towards, precision, room)
            _back(states, nugget, a, moves, u, delta, expected, towards, precision, room)
            if not _set_force(r, s, delta, c, force):
                break
            step = _step(r, s, c, at, pull, u, delta)
            for k in range(count):
                at[k] += step * (delta[k] - at[k])
                pull[k] += step * (u[k] - pull[k])
            _set_force(r, s, at, c, force)


@called
def _set_force(r: Array, s: Array, delta: Array, c: float, force: Array) -> bool:
    """Set the ``force`` (K,) of the readings in the tails, NaN of the others; whether it has changed."""
    changed = False
    for k in range(len(r)):
        left = r[k] - delta[k]
        new = np.sign(left) * c / s[k] if abs(left) > c * s[k] else np.nan
        changed = changed or not (new == force[k] or (np.isnan(new) and np.isnan(force[k])))
        force[k] = new
    return changed


@called
def _step(r: Array, s: Array, c: float, at: Array, pull: Array, u: Array, delta: Array) -> float:
    """How far from δ = ``at`` with A⁻¹δ = ``pull`` towards ``delta`` with A⁻¹δ = ``u`` J falls, at most 1.

    Its slope is linear in pieces: secants, with the value at an end that stays halved (Illinois), end in its root.
    """
    low, high = 0.0, 1.0
    rising = _slope(1.0, r, s, c, at, pull, u, delta)
    falling = first = _slope(0.0, r, s, c, at, pull, u, delta)
    if rising <= 0.0 or falling >= rising:  # the latter by rounding
        return 1.0
    step, side = 1.0, 0
    for _ in range(SECANTS):
        step = (falling * high - rising * low) / (falling - rising)
        slope = _slope(step, r, s, c, at, pull, u, delta)
        if abs(slope) <= SETTLED * abs(first):
            break
        if slope > 0.0:
            high, rising, falling, side = step, slope, falling * (0.5 if side > 0 else 1.0), 1
        else:
            low, falling, rising, side = step, slope, rising * (0.5 if side < 0 else 1.0), -1
    return step


@called
def _slope(step: float, r: Array, s: Array, c: float, at: Array, pull: Array, u: Array, delta: Array) -> float:
    """Of J along the way of :func:`_step`."""
    slope = 0.0
    for k in range(len(r)):
        way = delta[k] - at[k]
        left = (r[k] - at[k] - step * way) / s[k]
        slope += way * (pull[k] + step * (u[k] - pull[k]) - min(max(left, -c), c) / s[k])
    return slope


@called
def _ahead(
    states: States, r: Array, s: Array, own: Array, force: Array, a: Array, moves: Array, u: Array, expected: Array,
    towards: Array, precision: Array, room: Array,
) -> None:  # fmt: skip
    """The filter, for Gaussian errors of standard deviation ``s`` or a constant ``force``, where that is no NaN: a f as
    ``expected`` (K,) of each reading, what moves the state ``towards`` it (K, order), and ``u``, what is new in it,
    times its ``precision`` (K,), none of a constant force. ``room`` (2 order + 2, order) to work in.
    """
    order = len(states)
    mean, column, apart, half = room[0], room[1], room[2 : 2 + order], room[2 + order :]
    stationary = _stationary(order)
    mean[:], apart[:] = 0.0, 0.0
    for k in range(len(r)):
        if k > 0:
            _advance(len(states), moves[k - 1], mean, apart, column, half)
        expected[k] = a[k] * mean[0]
        for i in range(order):
            towards[k, i] = a[k] * (stationary[i, 0] + apart[i, 0])
        precision[k], u[k] = 0.0, force[k]
        if np.isnan(force[k]):
            precision[k] = 1.0 / (max(a[k] * towards[k, 0], 0.0) + s[k] * s[k] + own[k])
            u[k] = (r[k] - expected[k]) * precision[k]
        for i in range(order):
            mean[i] += towards[k, i] * u[k]
            for j in range(order):
                apart[i, j] -= towards[k, i] * towards[k, j] * precision[k]


@called
def _back(
    states: States, own: Array, a: Array, moves: Array, u: Array, delta: Array, expected: Array, towards: Array,
    precision: Array, room: Array,
) -> None:  # fmt: skip
    """The smoother behind :func:`_ahead`: u and δ of the mode."""
    order, adjoint, column = len(states), room[0], room[1]
    adjoint[:] = 0.0  # of the state before reading k, once that is reached
    for k in range(len(u) - 1, -1, -1):
        if k < len(u) - 1:
            column[:] = adjoint
            for i in range(order):
                adjoint[i] = 0.0
                for j in range(order):
                    adjoint[i] += moves[k, j, i] * column[j]
        for i in range(order):
            u[k] -= towards[k, i] * adjoint[i] * precision[k]
        adjoint[0] += a[k] * u[k]
        delta[k] = expected[k] + own[k] * u[k]
        for i in range(order):
            delta[k] += towards[k, i] * adjoint[i]


@called
def _stationary(order: int) -> Array:
    """P_∞ of a process of unit variance."""
    stationary = np.eye(order)
    if order == 3:
        stationary[1, 1] = 1.0 / 3.0
        stationary[0, 2] = stationary[2, 0] = -1.0 / 3.0
    return stationary


@called
def _set_transitions(order: int, d: Array, shrink: Array, moves: Array) -> None:
    """``moves`` (order, order, ≥ D) of the state over steps d = λΔ (D,), with e^{−d}."""
    for i in range(len(d)):
        x, e, q = d[i], shrink[i], 0.5 * d[i] * d[i]
        if order == 1:
            moves[0, 0, i] = e
        elif order == 2:
            moves[0, 0, i], moves[0, 1, i] = e * (1 + x), e * x
            moves[1, 0, i], moves[1, 1, i] = -e * x, e * (1 - x)
        else:
            moves[0, 0, i], moves[0, 1, i], moves[0, 2, i] = e * (1 + x + q), e * (x + 2 * q), e * q
            moves[1, 0, i], moves[1, 1, i], moves[1, 2, i] = -e * q, e * (1 + x - 2 * q), e * (x - q)
            moves[2, 0, i], moves[2, 1, i], moves[2, 2, i] = e * (q - x), e * (2 * q - 3 * x), e * (1 - 2 * x + q)


@called
def _advance(order: int, move: Array, mean: Array, apart: Array, column: Array, half: Array) -> None:
    """Mean and covariance of the state over a step; ``column`` and ``half`` are room to work in."""
    for i in range(order):
        column[i] = 0.0
        for j in range(order):
            column[i] += move[i, j] * mean[j]
            half[i, j] = 0.0
            for m in range(order):
                half[i, j] += move[i, m] * apart[m, j]
    for i in range(order):
        mean[i] = column[i]
        for j in range(order):
            apart[i, j] = 0.0
            for m in range(order):
                apart[i, j] += half[i, m] * move[j, m]
