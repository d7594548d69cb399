"""A slow, independent bubble with vapour transport and a conducting medium, in SI.

Nothing is shared with the package but the physical constants. Other unknowns: the mass fraction C of vapour, the
temperature T, ln p from Prosperetti's rate (the kernel: mole fraction, Kirchhoff variable, pressure from the mass of
gas). Mass-averaged velocity and explicit enthalpy diffusion (the kernel: molar-averaged, none). Other gas nodes. The
medium in the Lagrangian coordinate η = (r³ − R³)/3, finite volumes, where nothing is advected (the kernel: r/R,
collocation). The wall temperature is solved for inside the right-hand side. scipy integrates.

    ρ (∂C/∂t + v C') = ∇·(ρ D ∇C),      p = ρ R_mix T,   R_mix = C R_v + (1−C) R_g
    κ/(κ−1) p/T (∂T/∂t + v T') = ṗ + ∇·(K ∇T) + ρ D (c_pv − c_pg) C' T'
    v = [(κ−1) K T' − r ṗ/3]/(κ p) + D (R_v − R_g)/R_mix C'
    ṗ = 3/R [(κ−1) K T' − κ p Ṙ + κ p (R_v/R_mix) D C'/(1−C)]_R
    K_m T_m' = K T' + L ρ D C'/(1−C)  at the wall,   ρ_m c_m ∂T_m/∂t = K_m ∂/∂η(r⁴ ∂T_m/∂η) + 12 μ R⁴Ṙ²/r⁶

(Estrada et al. 2018; Prosperetti 1991), D = D_0 (p_∞/p)^D_p (T/T_∞)^D_T. ``Constants.spurious_wall_temperature`` puts
the public code's error into the evaporation term of ṗ: divided by T_w/T_∞. With ``accommodation`` α the vapour at the
wall is not saturated: ρ D C'/(1−C) = α (p_sat(T_w) − p_v)/√(2π R_v T_w), p_v its partial pressure.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from oracle import differenced, even_chebyshev
from scipy.integrate import solve_ivp

GAS_CONSTANT = 8.314462618


@dataclass(frozen=True)
class Constants:
    rho: float = 998.0
    c: float = 1484.0
    p_inf: float = 101325.0
    S: float = 0.072
    T_inf: float = 298.15
    kappa: float = 1.4
    A: float = 5.28e-5
    B: float = 1.165e-2
    K_m: float = 0.55
    c_m: float = 4181.0
    D: float = 24.2e-6
    D_p: float = 0.0
    D_T: float = 0.0
    L: float = 2264.76e3
    M_g: float = 28.966e-3
    M_v: float = 18.01528e-3
    spurious_wall_temperature: bool = False
    accommodation: float = np.inf


def p_sat(T):
    return 1.17e11 * np.exp(-5200.0 / T)


class Bubble:
    """Neo-Hookean Kelvin–Voigt, released from R_max. ``nodes`` in the gas, ``cells`` in the medium.

    ``vapour``: "none", "frozen" or "transport"; ``conducting``: whether the medium's temperature is solved.
    """

    def __init__(self, G, mu, R_max, R_eq, *, vapour, conducting, nodes, cells=80, constants=None):
        k = constants or Constants()
        self.k, self.G, self.mu, self.R_max, self.R_eq = k, G, mu, R_max, R_eq
        self.transport, self.conducting = vapour == "transport", conducting
        y, self.D1, self.L = even_chebyshev(nodes)  # wall first
        self.y = y[:, None]
        self.m, self.n = nodes, cells if conducting else 0
        pv = 0.0 if vapour == "none" else p_sat(k.T_inf)
        pg = (k.p_inf + 2 * k.S / R_eq - pv) * (R_eq / R_max) ** 3
        self.p0 = pg + pv
        self.Rv, self.Rg = GAS_CONSTANT / k.M_v, GAS_CONSTANT / k.M_g
        self.C0 = self.saturated(k.T_inf, self.p0)
        # Faces η_f, geometrically spaced from 1e-4 of the thinnest layer of interest to many layers at R_max.
        if conducting:
            zeta = np.linspace(0, 1, cells + 1)
            first, last = 2e-18, 2e-11
            self.faces = first * np.expm1(zeta * np.log1p(last / first))
            self.centres = first * np.expm1((zeta[1:] + zeta[:-1]) / 2 * np.log1p(last / first))
            self.volumes = np.diff(self.faces)[:, None]

    def saturated(self, T, p):
        """Mass fraction of vapour in equilibrium at a wall of temperature T."""
        x = p_sat(T) / p
        return x * self.Rg / (x * self.Rg + (1 - x) * self.Rv)

    def diffusivity(self, T, p):
        k = self.k
        return k.D * (k.p_inf / p) ** k.D_p * (T / k.T_inf) ** k.D_T

    def wall_fraction(self, R, p, T, C):
        """The C_w of a wall of temperature ``T`` with C ``C[1:]`` inside: what diffuses is what evaporates, in which
        C_w is of second degree.
        """
        k = self.k
        if np.isinf(k.accommodation):
            return self.saturated(T, p)
        rate, spread = k.accommodation / np.sqrt(2 * np.pi * self.Rv * T), p / T * self.diffusivity(T, p) / R
        square = rate * (p_sat(T) * (self.Rv - self.Rg) - p * self.Rv)
        none = spread * (self.D1[0, 1:] @ C[1:]) - rate * p_sat(T) * self.Rg
        once = spread * self.D1[0, 0] + rate * p_sat(T) * self.Rg - square
        return -2 * none / (once + np.sqrt(once**2 - 4 * square * none))

    def wall_temperature(self, R, p, T, C, T_m):
        """The T_w at which the heat fluxes balance (Newton with a differenced slope)."""
        k = self.k
        e0, e1 = self.centres[0], self.centres[1]
        weights = np.array([-(e0 + e1) / (e0 * e1), e1 / (e0 * (e1 - e0)), -e0 / (e1 * (e1 - e0))])
        gas, vapour = self.D1[0, 1:] @ T[1:], self.D1[0, 1:] @ C[1:] if self.transport else 0.0

        def balance(w):
            inward = (k.A * w + k.B) * (self.D1[0, 0] * w + gas) / R
            if self.transport:
                Cw = self.wall_fraction(R, p, w, C)
                rho = p / ((Cw * self.Rv + (1 - Cw) * self.Rg) * w)
                inward += k.L * rho * self.diffusivity(w, p) / (1 - Cw) * (self.D1[0, 0] * Cw + vapour) / R
            return inward - k.K_m * R**2 * (weights[0] * w + weights[1] * T_m[0] + weights[2] * T_m[1])

        w = T_m[0]
        for _ in range(30):
            f = balance(w)
            step = f / ((balance(w + 1e-5) - f) / 1e-5)
            w = w - np.clip(step, -5.0, 5.0)
            if np.all(np.abs(step) < 1e-10):
                break
        return w

    def rhs(self, t, state):
        """d/dt of one state (n,), or of those in the columns (n, k)."""
        k, y, D1, m = self.k, self.y, self.D1, self.m
        X = state.reshape(len(state), -1)
        R, V, p = X[0], X[1], np.exp(X[2])
        T = X[2 : 2 + m].copy()
        T[0] = k.T_inf
        C = X[1 + m : 1 + 2 * m].copy() if self.transport else None
        T_m = X[len(X) - self.n :]
        if self.conducting:
            T[0] = self.wall_temperature(R, p, T, C, T_m)
        K = k.A * T + k.B
        dT = D1 @ T / R
        heat = (k.kappa - 1) * K * dT
        drive = heat[0] - k.kappa * p * V
        if self.transport:
            C[0] = self.wall_fraction(R, p, T[0], C)
            Rmix = C * self.Rv + (1 - C) * self.Rg
            dC = D1 @ C / R
            D = self.diffusivity(T, p)
            evaporation = k.kappa * p * self.Rv / Rmix[0] * D[0] / (1 - C[0]) * dC[0]
            drive += evaporation / (T[0] / k.T_inf if k.spurious_wall_temperature else 1.0)
        p_dot = 3 / R * drive
        v = (heat - y * R * p_dot / 3) / (k.kappa * p)
        energy = p_dot + K * (self.L @ T) / R**2 + k.A * dT**2
        rates = [X[:0]] * 2
        if self.transport:
            v = v + D * (self.Rv - self.Rg) / Rmix * dC
            rho = p / (Rmix * T)
            enthalpy = k.kappa / (k.kappa - 1) * (self.Rv - self.Rg)
            energy = energy + rho * D * enthalpy * dC * dT
            d_ln_rho = -(self.Rv - self.Rg) / Rmix * dC - dT / T
            d_ln_D = k.D_T * dT / T
            C_dot = D * (self.L @ C / R**2 + (d_ln_rho + d_ln_D) * dC) - (v - y * V) * dC
            rates[1] = C_dot[1:]
        T_dot = (k.kappa - 1) / k.kappa * T / p * energy - (v - y * V) * dT
        rates[0] = T_dot[1:]
        medium = self.medium(R, V, T[0], T_m) if self.conducting else X[:0]
        out = np.concatenate([[V, self.acceleration(R, V, p, p_dot), p_dot / p], *rates, medium])
        return out.reshape(state.shape)

    def medium(self, R, V, wall, T_m):
        k = self.k
        r = np.cbrt(R**3 + 3 * self.faces[:, None])
        flux = np.zeros((self.n + 1, len(R)))
        flux[1:-1] = r[1:-1] ** 4 * np.diff(T_m, axis=0) / np.diff(self.centres)[:, None]
        e0, e1 = self.centres[:2]
        slope = -(e0 + e1) / (e0 * e1) * wall + e1 / (e0 * (e1 - e0)) * T_m[0] - e0 / (e1 * (e1 - e0)) * T_m[1]
        flux[0] = R**4 * slope
        heating = 12 * self.mu * R**4 * V**2 / np.cbrt(R**3 + 3 * self.centres[:, None]) ** 6
        return (k.K_m * np.diff(flux, axis=0) / self.volumes + heating) / (k.rho * k.c_m)

    def acceleration(self, R, V, p, p_dot):
        k, s = self.k, self.R_eq / R
        bracket = p - k.p_inf - 2 * k.S / R - self.G / 2 * (5 - 4 * s - s**4) - 4 * self.mu * V / R
        rate = p_dot + 2 * k.S * V / R**2 - 2 * self.G * V / R * (s + s**4) + 4 * self.mu * V**2 / R**2
        right = ((1 + V / k.c) * bracket + R / k.c * rate) / k.rho - 1.5 * (1 - V / (3 * k.c)) * V**2
        return right / ((1 - V / k.c) * R + 4 * self.mu / (k.rho * k.c))

    def solve(self, times, rtol=1e-7, method="LSODA"):
        """R (K,) in m at ``times``."""
        k, gas = self.k, self.m - 1
        state = np.r_[self.R_max, 0.0, np.log(self.p0), np.full(gas, k.T_inf)]
        if self.transport:
            state = np.r_[state, np.full(gas, self.C0)]
        state = np.r_[state, np.full(self.n, k.T_inf)]
        scale = np.r_[1e-7, 1e-2, 1.0, np.full(gas, 300.0), np.full(gas if self.transport else 0, 1.0)]
        scale = np.r_[scale, np.full(self.n, 300.0)]
        atol = rtol * scale
        jac = differenced(self.rhs, scale)
        s = solve_ivp(self.rhs, (0, times[-1]), state, method, rtol=rtol, atol=atol, t_eval=times, jac=jac)
        assert s.success, s.message
        return s.y[0]
