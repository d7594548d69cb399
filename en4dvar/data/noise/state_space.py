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
from en4dvar.plumbing.compiled import called, inlined, kernel

Indices = npt.NDArray[np.intp]


def innovations(residuals: Array, errors: Array, amplitudes: Array, lengths: Array, steps: Array, nu: float) -> Array:
    """v and the diagonal of L (2, B, K) of B runs; NaN where R + A is singular to rounding, as a dense factor would be.

    residuals: (B, K) y − m. errors: (B, K) variances of ε. amplitudes: (B, K) a g.
    lengths: (B,) ℓ. steps: (K − 1,) ≥ 0 between readings. nu: ½, 3/2 or 5/2.
    """
    d, shrink, which = _different(lengths, steps, nu)
    r, e, a = (np.ascontiguousarray(part, dtype=float) for part in (residuals, errors, amplitudes))
    white = np.empty((2, *r.shape))
    _whiten(int(nu + 0.5), r, e, a, d, shrink, which, white)
    with np.errstate(all="ignore"):
        rounding = 4 * r.shape[1] * np.finfo(float).eps * np.square(a).max(axis=1)
        singular = np.square(white[1]).min(axis=1) < rounding
    white[:, singular] = np.nan
    return white


def _different(lengths: Array, steps: Array, nu: float) -> tuple[Array, Array, Indices]:
    """λΔ and e^{−λΔ} (B, U) of each different step, and which of them each step (K − 1,) is."""
    with np.errstate(all="ignore"):
        rates = np.sqrt(2 * nu) / lengths
        least = steps[steps > 0].min(initial=np.finfo(float).max)  # those of a camera are equal but for rounding
        different, which = np.unique(np.round(steps / least, 12), return_inverse=True)
        d = np.outer(rates, different * least)
        return d, np.exp(-d), which


@kernel
def _whiten(
    order: int, residuals: Array, errors: Array, amplitudes: Array, d: Array, shrink: Array, which: Indices,
    white: Array,
) -> None:  # fmt: skip
    """``white`` (2, B, K) of :func:`innovations`, run by run."""
    count = residuals.shape[1]
    force, room, moves = np.full(count, np.nan), np.empty((count, 5)), np.empty((d.shape[1], 9))
    for run in range(len(residuals)):
        new, root = white[0, run], white[1, run]
        _set_transitions(order, d[run], shrink[run], moves)
        _ahead(order, residuals[run], errors[run], force, amplitudes[run], moves, which, room, new)
        for k in range(count):
            root[k] = 1.0 / np.sqrt(room[k, 4]) if room[k, 4] > 0.0 else np.nan  # numba raises at a division by zero
            new[k] *= root[k]


def boxed(
    residuals: Array, std: Array, own: Array, amplitudes: Array, lengths: Array, steps: Array, nu: float, c: float
) -> Array:
    """u = ρ'(ε/s)/s and δ (2, B, K) of B runs at the mode of Huber's loss and the process; NaN where r is not finite.

    residuals: (B, K) y − m. std: (B, K) s of ε. own: (B, K) variances of what in δ each reading has of its own.
    amplitudes: (B, K) a g. lengths: (B,) ℓ. steps: (K − 1,) ≥ 0 between readings. nu: ½, 3/2 or 5/2. c: threshold.
    """
    mode = np.empty((2, *residuals.shape))
    r, s, nuggets, a = (np.ascontiguousarray(part, dtype=float) for part in (residuals, std, own, amplitudes))
    _boxed(int(nu + 0.5), r, s, nuggets, a, *_different(lengths, steps, nu), c, mode)
    return mode


SETTLED = 1e-10  # of the slope of J at the end of a step, against that at its begin
NEWTON, SECANTS = 200, 50  # iterations, and those for the length of a step


@kernel
def _boxed(
    order: int, residuals: Array, std: Array, own: Array, amplitudes: Array, d: Array, shrink: Array, which: Indices,
    c: float, mode: Array,
) -> None:  # fmt: skip
    """``mode`` (2, B, K), run by run: Newton's method on which readings are in the tails, each step as long as J falls.

    The first step is to the mode of Gaussian errors. J is convex and quadratic in pieces, so that this ends; whole
    steps may go round in circles.
    """
    count = residuals.shape[1]
    force, at, pull, errors = np.empty(count), np.empty(count), np.empty(count), np.empty(count)
    room, moves = np.empty((count, 5)), np.empty((d.shape[1], 9))
    for run in range(len(residuals)):
        r, s, nugget, a, u, delta = (
            residuals[run], std[run], own[run], amplitudes[run], mode[0, run], mode[1, run],
        )  # fmt: skip
        if not np.isfinite(np.sum(r) + np.sum(s) + np.sum(a) + np.sum(d[run])):
            mode[:, run] = np.nan
            continue
        _set_transitions(order, d[run], shrink[run], moves)
        for k in range(count):
            errors[k] = s[k] * s[k] + nugget[k]
        at[:], pull[:], force[:] = 0.0, 0.0, np.nan
        for _ in range(NEWTON):
            _ahead(order, r, errors, force, a, moves, which, room, u)
            _back(nugget, a, moves, which, room, u, delta)
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
    """How far from δ = ``at`` with A⁻¹δ = ``pull`` towards ``delta`` with A⁻¹δ = ``u`` J falls, at most 1. Its slope is
    linear in pieces: secants, with the value at an end that stays halved (Illinois), end in its root.
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


@inlined
def _dot(a: tuple[float, float, float], b: tuple[float, float, float]) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@called
def _ahead(
    order: int, r: Array, errors: Array, force: Array, a: Array, moves: Array, which: Indices, room: Array, u: Array
) -> None:  # fmt: skip
    """The filter, for Gaussian errors of variance ``errors`` (K,) or a constant ``force`` (K,), where that is no NaN.

    ``room`` (K, 5) holds of each reading what moves the states towards it, a f as expected of it, and the precision of
    what is new in it, none of a constant force; ``u`` (K,) is what is new times that. States that a process of lower
    order does not have stay zero.
    """
    joint = -1.0 / 3.0 if order == 3 else 0.0  # of the first and the third state in P_∞, which is 1 of the first
    m0 = m1 = m2 = 0.0
    p00 = p01 = p02 = p11 = p12 = p22 = 0.0  # P − P_∞
    for k in range(len(r)):
        if k > 0:
            f = moves[which[k - 1]]
            f0, f1, f2 = (f[0], f[1], f[2]), (f[3], f[4], f[5]), (f[6], f[7], f[8])
            mean, p0, p1, p2 = (m0, m1, m2), (p00, p01, p02), (p01, p11, p12), (p02, p12, p22)
            m0, m1, m2 = _dot(f0, mean), _dot(f1, mean), _dot(f2, mean)
            a0 = _dot(f0, p0), _dot(f0, p1), _dot(f0, p2)
            a1 = _dot(f1, p0), _dot(f1, p1), _dot(f1, p2)
            a2 = _dot(f2, p0), _dot(f2, p1), _dot(f2, p2)
            p00, p01, p02 = _dot(a0, f0), _dot(a0, f1), _dot(a0, f2)
            p11, p12, p22 = _dot(a1, f1), _dot(a1, f2), _dot(a2, f2)
        t0, t1, t2 = a[k] * (1.0 + p00), a[k] * p01, a[k] * (joint + p02)
        expected, precision, new = a[k] * m0, 0.0, force[k]
        if np.isnan(new):
            variance = max(a[k] * t0, 0.0) + errors[k]
            precision = 1.0 / variance if variance > 0.0 else np.nan
            new = (r[k] - expected) * precision
        room[k, 0], room[k, 1], room[k, 2], room[k, 3], room[k, 4], u[k] = t0, t1, t2, expected, precision, new
        m0, m1, m2 = m0 + t0 * new, m1 + t1 * new, m2 + t2 * new
        t0, t1, t2, x0, x1, x2 = t0 * precision, t1 * precision, t2 * precision, t0, t1, t2
        p00, p01, p02 = p00 - t0 * x0, p01 - t0 * x1, p02 - t0 * x2
        p11, p12, p22 = p11 - t1 * x1, p12 - t1 * x2, p22 - t2 * x2


@called
def _back(own: Array, a: Array, moves: Array, which: Indices, room: Array, u: Array, delta: Array) -> None:
    """The smoother behind :func:`_ahead`: u and δ of the mode."""
    m0 = m1 = m2 = 0.0  # the adjoint of the state before reading k, once that is reached
    for k in range(len(u) - 1, -1, -1):
        if k < len(u) - 1:
            f = moves[which[k]]
            m0, m1, m2 = (
                f[0] * m0 + f[3] * m1 + f[6] * m2, f[1] * m0 + f[4] * m1 + f[7] * m2, f[2] * m0 + f[5] * m1 + f[8] * m2,
            )  # fmt: skip
        t0, t1, t2 = room[k, 0], room[k, 1], room[k, 2]
        u[k] -= (t0 * m0 + t1 * m1 + t2 * m2) * room[k, 4]
        m0 += a[k] * u[k]
        delta[k] = room[k, 3] + own[k] * u[k] + t0 * m0 + t1 * m1 + t2 * m2


@called
def _set_transitions(order: int, d: Array, shrink: Array, moves: Array) -> None:
    """``moves`` (U, 9), row by row, of the states over steps d = λΔ (U,), with e^{−d}."""
    for i in range(len(d)):
        x, e, q, f = d[i], shrink[i], 0.5 * d[i] * d[i], moves[i]
        f[:] = 0.0
        if order == 1:
            f[0] = e
        elif order == 2:
            f[0], f[1] = e * (1 + x), e * x
            f[3], f[4] = -e * x, e * (1 - x)
        else:
            f[0], f[1], f[2] = e * (1 + x + q), e * (x + 2 * q), e * q
            f[3], f[4], f[5] = -e * q, e * (1 + x - 2 * q), e * (x - q)
            f[6], f[7], f[8] = e * (q - x), e * (2 * q - 3 * x), e * (1 - 2 * x + q)
