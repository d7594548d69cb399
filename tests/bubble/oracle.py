"""A slow, independent bubble: SI units, temperature itself, its own Chebyshev grid, pressure from the wall flux,
scipy Radau.

Nothing here is shared with the package but the physical constants: other unknowns (R, Ṙ, p, T), other collocation
nodes, no table, no compiled code, so that an error in the derivation of the fast kernel shows.
"""

from __future__ import annotations

import numpy as np
from numpy.polynomial import chebyshev
from scipy.integrate import solve_ivp

RHO, C, P_INF, S, T_INF, KAPPA, A, B = 998.0, 1484.0, 101325.0, 0.072, 298.15, 1.4, 5.28e-5, 1.165e-2


def pulse(t, amplitude=-24e6, frequency=1e6, n=3.7, delay=5e-6):
    phase = 2 * np.pi * frequency * (t - delay)
    if abs(phase) >= np.pi:
        return 0.0, 0.0
    base = 0.5 * (1 + np.cos(phase))
    slope = -0.5 * np.sin(phase) * 2 * np.pi * frequency
    return amplitude * base**n, amplitude * n * base ** (n - 1) * slope


def even_chebyshev(m):
    """Nodes y ∈ (0, 1] (wall first) and the matrices of d/dy and the spherical Laplacian on even functions."""
    full = np.cos(np.pi * np.arange(2 * m) / (2 * m - 1))
    degrees = range(0, 2 * m, 2)
    basis = [chebyshev.Chebyshev.basis(d) for d in degrees]
    y = full[:m]
    values = np.array([b(y) for b in basis]).T
    first = np.array([b.deriv()(y) for b in basis]).T @ np.linalg.inv(values)
    second = np.array([b.deriv(2)(y) for b in basis]).T @ np.linalg.inv(values)
    return y, first, second + 2 / y[:, None] * first


def differenced(rhs, least=1.0):
    """∂f/∂x (n, n) of ``rhs(t, x)``, which takes states (n, k), by differences of one call: LSODA would make n.

    ``least``: below what size a number is taken for one of that size.
    """

    def jacobian(t, x):
        step = 1.5e-8 * np.maximum(np.abs(x), least)
        return (rhs(t, x[:, None] + np.diag(step)) - rhs(t, x)[:, None]) / step

    return jacobian


def integrate(times, G, alpha, mu, R0, m=20, rtol=1e-8, start=4.5e-6, reading="instantaneous", heat=True):
    """R (K,) at ``times`` > ``start`` for the acoustic quadratic-law Kelvin–Voigt bubble."""
    y, D, L = even_chebyshev(m)

    def conductivity(T):
        return A * T + B

    def gas(R, Rdot, p, T):
        if not heat:
            return -3 * KAPPA * p * Rdot / R, np.zeros(0)
        K = conductivity(T)
        gradient = D @ T / R
        p_dot = 3 / R * ((KAPPA - 1) * K[0] * gradient[0] - KAPPA * p * Rdot)
        # ∇·(K∇T) = K ∇²T + A (∂T/∂r)²
        divergence = K * (L @ T) / R**2 + A * gradient**2
        velocity = ((KAPPA - 1) * K * gradient - y * R * p_dot / 3) / (KAPPA * p)
        T_dot = (KAPPA - 1) / KAPPA * T / p * (p_dot + divergence) - (velocity - y * Rdot) * gradient
        T_dot[0] = 0.0
        return p_dot, T_dot

    def rhs(t, state):
        R, Rdot, p = state[0], state[1], np.exp(state[2])
        T = np.concatenate([[T_INF], state[3:]]) if heat else np.zeros(0)
        p_dot, T_dot = gas(R, Rdot, p, T)
        s = R0 / R
        J_e = G * (3 * alpha - 1) / 2 * (5 - 4 * s - s**4)
        J_e += 2 * G * alpha * (27 / 40 + s**8 / 8 + s**5 / 5 + s**2 - 2 / s)
        dJ_dR = G * (3 * alpha - 1) / 2 * (4 * s**2 + 4 * s**5) / R0
        dJ_dR += 2 * G * alpha * (-(s**9) - s**6 - 2 * s**3 - 2) / R0
        when = t if reading == "instantaneous" else t + R / C
        p_f, dp_f = pulse(when)
        bracket = p - P_INF - p_f - 2 * S / R + J_e - 4 * mu * Rdot / R
        rate = p_dot + 2 * S * Rdot / R**2 + dJ_dR * Rdot + 4 * mu * Rdot**2 / R**2
        rate -= {"instantaneous": dp_f, "retarded": 0.0, "as-printed": dp_f * (1 + Rdot / C)}[reading]
        right = ((1 + Rdot / C) * bracket + R / C * rate) / RHO - 1.5 * (1 - Rdot / (3 * C)) * Rdot**2
        acceleration = right / ((1 - Rdot / C) * R + 4 * mu / (RHO * C))
        return np.concatenate([[Rdot, acceleration, p_dot / p], T_dot[1:]])

    p0 = P_INF + 2 * S / R0
    state = np.concatenate([[R0, 0.0, np.log(p0)], np.full(m - 1 if heat else 0, T_INF)])
    scale = np.concatenate([[1e-12, 1e-6, 1e-4], np.full(len(state) - 3, 1e-4)]) * rtol * 1e4
    end = 5.5e-6
    first = solve_ivp(rhs, (start, end), state, "Radau", rtol=rtol, atol=scale, max_step=2e-8)
    assert first.success
    later = solve_ivp(rhs, (end, times[-1]), first.y[:, -1], "Radau", rtol=rtol, atol=scale, t_eval=times)
    assert later.success
    return later.y[0]
