"""The equations the public rheometry suite integrates (IMRv2, finite differences), each departure a switch.

For explaining ``imr_suite.npz``: with every switch of :class:`Suite` as stored the suite's trajectories come out, and
flipping one shows what it costs. Scaled by R0, p_∞ and ρ as there; written from the published equations
(github.com/InertialMicrocavitationRheometry/IMRv2, ``src/forward_solver``) and integrated with scipy.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from oracle import differenced, even_chebyshev
from scipy.integrate import solve_ivp

RAYLEIGH_PLESSET, PRESSURE, ENTHALPY, GILMORE = 1, 2, 3, 4
NONE, NEO_HOOKEAN, QUADRATIC, UPPER_CONVECTED = 0, 1, 2, 5
M_V, M_G = 18.01528e-3, 28.966e-3


@dataclass(frozen=True)
class Suite:
    """What the suite does differently from the equations of this project; ``CORRECT`` is the other choice of each."""

    total_pressure_rate: bool = True
    """Polytropic: ṗ = −3κ (p_gas + p_v) Ṙ/R instead of −3κ p_gas Ṙ/R."""
    inconsistent_conductivity: bool = True
    """K(T) is scaled by the mean of the gas's and the vapour's K(T_∞), but θ(T) takes it to be 1 at T_∞; and the
    balance at a conducting wall has the slope of the gas alone. Otherwise scaled by K(T_∞) of the mixture."""
    elastic_heating: bool = True
    """The medium is heated by all of τ : ∇u, stored elastic energy included, instead of by the dashpot alone; a
    Maxwell liquid by a dashpot it does not have, instead of not at all."""
    gilmore_without_factor: bool = True
    """Gilmore: (R/C) Ḣ instead of (1 − Ṙ/C)(R/C) Ḣ."""
    spurious_wall_temperature: bool = True
    """Vapour transport: the evaporation term of ṗ is divided by T_w/T_∞."""
    differences: bool = True
    """Second-order differences in the gas instead of Chebyshev collocation."""
    nodes: int = 70
    medium_nodes: int = 70
    length: float = 2.0


CORRECT = Suite(False, False, False, False, False, False)


def p_sat(T):
    return 1.17e11 * np.exp(-5200.0 / T)


def differences(n):
    """Second-order matrices of d/dy and the spherical Laplacian on y = 0 … 1."""
    h = 1.0 / (n - 1)
    y = np.arange(n) * h
    D, L = np.zeros((n, n)), np.zeros((n, n))
    for i in range(1, n - 1):
        D[i, [i - 1, i + 1]] = -0.5 / h, 0.5 / h
        L[i, [i - 1, i, i + 1]] = np.array([1 - h / y[i], -2, 1 + h / y[i]]) / h**2
    D[-1, -3:] = np.array([0.5, -2, 1.5]) / h
    L[0, :2] = -6 / h**2, 6 / h**2
    return y, D, L


class Case:
    """One stored case: columns of ``imr_suite.npz`` in ``c`` (a dict of scalars)."""

    def __init__(self, c, suite=Suite()):
        self.c, self.s = c, suite
        P8, R0 = c["P8"], c["R0"]
        U = np.sqrt(P8 / c["rho8"])
        self.t0 = R0 / U
        self.radial, self.stress = int(c["radial"]), int(c["stress"])
        self.heat, self.conducting = bool(c["bubtherm"]), bool(c["medtherm"])
        self.kappa, self.iRe = c["kappa"], c["mu"] * U / (P8 * R0)
        self.iCa = c["G"] / P8
        self.alphax = c["alphax"]
        self.De, self.LAM = c["lambda1"] / self.t0, c["lambda2"] / c["lambda1"]
        self.iWe, self.cstar = 2 * c["surft"] / (P8 * R0), c["C8"] / U
        self.B, self.n = c["GAM"] / P8, c["nstate"]
        self.req = c["Req"] / R0
        self.pv, self.pg = c["vapor"] * p_sat(c["T8"]) / P8, c["P0_gas"] / P8
        kv = self.vapour_fraction()
        A, B = kv * c["ATv"] + (1 - kv) * c["ATg"], kv * c["BTv"] + (1 - kv) * c["BTg"]
        K8 = A * c["T8"] + B
        if suite.inconsistent_conductivity:
            K8 = (c["ATg"] * c["T8"] + c["BTg"] + c["ATv"] * c["T8"] + c["BTv"]) / 2
        self.chi = c["T8"] * K8 / (P8 * R0 * U)
        self.iota = c["Km"] / K8
        self.Fo = c["Km"] / (c["rho8"] * c["Cp"]) / (U * R0)
        self.Br = U**2 / (c["Cp"] * c["T8"])
        self.a, self.b = A * c["T8"] / K8, B / K8
        self.a_wall = c["ATg"] * c["T8"] / K8 if suite.inconsistent_conductivity else self.a
        n = suite.nodes
        self.N = n if self.heat else 0
        self.transport = bool(c.get("masstrans", 0))
        self.C = n if self.transport else 0
        self.M = suite.medium_nodes if self.conducting else 0
        self.Rv, self.Rg = (8.3144598 / M * c["rho8"] * c["T8"] / P8 for M in (M_V, M_G))
        self.Fom, self.latent = c.get("D", 0.0) / (U * R0), c.get("L", 0.0) / U**2
        self.T8, self.P8, self.kv0 = c["T8"], P8, kv
        self.gas_v = np.array([c["ATv"] * c["T8"], c["BTv"]]) / K8
        self.gas_g = np.array([c["ATg"] * c["T8"], c["BTg"]]) / K8
        self.guess = 0.0
        if suite.differences:
            y, self.D, self.L = differences(n)
        else:
            y, self.D, self.L = (a[::-1] for a in even_chebyshev(n))
            self.D, self.L = self.D[:, ::-1], self.L[:, ::-1]
        self.y = y[:, None]
        self.hm = -2.0 / (suite.medium_nodes - 1)
        self.xi = np.linspace(1, -1, suite.medium_nodes)[:-1, None]
        self.yT = (2 / (self.xi + 1) - 1) * suite.length + 1

    def vapour_fraction(self):
        """Mass fraction of vapour at time zero as the suite computes it."""
        ratio = M_G / M_V  # R_v / R_g
        return 1 / (1 + ratio * self.pg / self.pv) if self.pv else 0.0

    def temperature(self, theta, a):
        return (a - 1 + np.sqrt(1 + 2 * theta * a)) / a

    def saturated(self, T, P):
        """Mass fraction of vapour at a wall of temperature T (in T_∞)."""
        return 1 / (1 + self.Rv / self.Rg * (P / (p_sat(T * self.T8) / self.P8) - 1))

    def wall_with_vapour(self, theta, Tm, kv, P):
        """As :meth:`wall`, with the latent heat of the evaporating flux."""
        a = kv[-1] * self.gas_v[0] + (1 - kv[-1]) * self.gas_g[0]

        def balance(w):
            T = self.temperature(w, a)
            k = self.saturated(T, P)
            out = self.chi * (self.D[-1, :-1] @ theta[:-1] + self.D[-1, -1] * w)
            latent = self.Fom * self.latent * P / ((k * self.Rv + (1 - k) * self.Rg) * T * (1 - k))
            out += latent * (self.D[-1, :-1] @ kv[:-1] + self.D[-1, -1] * k)
            slope = (-1.5 * T + 2 * Tm[1] - 0.5 * Tm[2]) / self.hm * (-2 / self.s.length)
            return out - self.chi * self.iota * slope

        w = np.full(len(P), self.guess)
        for _ in range(30):
            f = balance(w)
            step = f / ((balance(w + 1e-7) - f) / 1e-7)
            w = w - step
            if np.all(np.abs(step) < 1e-12):
                break
        self.guess = w[0]
        return w

    def wall(self, theta, Tm):
        """Kirchhoff variable at the wall for which the heat flux is continuous."""
        gas0, gas1 = self.D[-1, :-1] @ theta[:-1], self.D[-1, -1]
        k = self.iota * (-2 / self.s.length) / self.hm
        # θ_y − (K_m/K_8) T_y = 0
        a = self.a_wall
        w = 0.0
        for _ in range(20):
            root = np.sqrt(1 + 2 * w * a)
            T = (a - 1 + root) / a
            f = gas1 * w + gas0 - k * (-1.5 * T + 2 * Tm[1] - 0.5 * Tm[2])
            df = gas1 + k * 1.5 / root
            step = f / df
            w = w - step
            if np.all(np.abs(step) < 1e-14):
                break
        return w

    def rhs(self, t, state):
        """d/dt of one state (n,), or of those in the columns (n, k)."""
        X = state.reshape(len(state), -1)
        R, V, P = X[0], X[1], X[2]
        k, s = self.kappa, self.s
        N, M = self.N, self.M
        out = np.zeros_like(X)
        if self.heat:
            theta, Tm = X[3 : 3 + N].copy(), X[3 + N : 3 + N + M].copy()
            kv = self.kv0
            if self.transport:
                kv = X[3 + N + M : 3 + N + M + N].copy()
                theta[-1] = self.wall_with_vapour(theta, Tm, kv, P)
            else:
                theta[-1] = self.wall(theta, Tm) if M else 0.0
            a, b = (kv * v + (1 - kv) * g for v, g in zip(self.gas_v, self.gas_g, strict=True))
            T = self.temperature(theta, a)
            K = a * T + b
            d, dd = self.D @ theta, self.L @ theta
            drive = self.chi * (k - 1) * d[-1] / R - k * P * V
            if self.transport:
                kv[-1] = self.saturated(T[-1], P)
                dkv, Rmix = self.D @ kv, kv * self.Rv + (1 - kv) * self.Rg
                flux = k * P * self.Fom * self.Rv * dkv[-1] / (R * Rmix[-1] * (1 - kv[-1]))
                drive += flux / T[-1] if s.spurious_wall_temperature else flux
            Pdot = 3 / R * drive
            u = (self.chi / R * (k - 1) * d - self.y * R * Pdot / 3) / (k * P)
            if self.transport:
                gradient = (self.Rv - self.Rg) / Rmix * dkv
                u = u + self.Fom / R * gradient
                bend = self.L @ kv - dkv * (d / (np.sqrt(1 + 2 * a * theta) * T) + gradient)
                change = self.Fom / R**2 * bend - (u - V * self.y) / R * dkv
                change[-1] = 0.0
                out[3 + N + M : 3 + N + M + N] = change
            rate = (self.chi * dd / R**2 + Pdot) * ((k - 1) / k * K * T / P) - d * (u - self.y * V) / R
            if self.transport:
                rate = rate + self.Fom / R**2 * gradient * d
            rate[-1] = 0.0
            out[3 : 3 + N] = rate
        else:
            gas = self.pg * R ** (-3 * k)
            P = gas + self.pv
            Pdot = -3 * k * V / R * (P if s.total_pressure_rate else gas)
        if M:
            out[3 + N : 3 + N + M - 1] = self.medium(R, V, Tm, T[-1])
        st = self.req / R
        S, Sdot, A = 0.0, 0.0, 0.0
        if self.stress in (NEO_HOOKEAN, QUADRATIC):
            al = self.alphax if self.stress == QUADRATIC else 0.0
            Se = (3 * al - 1) * self.iCa / 2 * (5 - 4 * st - st**4)
            dSe = V / R * (3 * al - 1) * self.iCa / 2 * (4 * st + 4 * st**4)
            Se += 2 * al * self.iCa * (27 / 40 + st**8 / 8 + st**5 / 5 + st**2 - 2 / st)
            dSe -= 2 * al * self.iCa * V / R * (st**8 + st**5 + 2 * st**2 + 2 / st)
            S = Se - 4 * self.iRe * V / R
            Sdot = dSe + 4 * self.iRe * (V / R) ** 2
            A = 4 * self.iRe
        elif self.stress == UPPER_CONVECTED:
            s1, s2 = X[-2], X[-1]
            source = -2 * (1 - self.LAM) * self.iRe / self.De * V / R
            out[-2] = -s1 / self.De - V / R * s1 + source
            out[-1] = -s2 / self.De - 4 * V / R * s2 + source
            S = s1 + s2 - 4 * self.LAM * self.iRe * V / R
            Sdot = out[-2] + out[-1] + 4 * self.LAM * self.iRe * (V / R) ** 2
            A = 4 * self.LAM * self.iRe
        out[0], out[2] = V, Pdot
        out[1] = self.acceleration(R, V, P, Pdot, S, Sdot, A)
        return out.reshape(state.shape)

    def medium(self, R, V, Tm, wall):
        Tm[0], Tm[-1] = wall, 1.0
        x1, y, L = self.xi + 1, self.yT, self.s.length
        d, dd = np.zeros((2, len(y), len(R)))
        d[1:] = (Tm[2:] - Tm[:-2])[: len(y) - 1] / (2 * self.hm)
        dd[1:] = (Tm[2:] - 2 * Tm[1:-1] + Tm[:-2])[: len(y) - 1] / self.hm**2
        flow = x1**2 / (L * R) * (V / y**2 * (1 - y**3) / 2 + self.Fo / R * (x1 / (2 * L) - 1 / y)) * d
        heat = np.zeros_like(y)
        if self.stress != NONE and (self.s.elastic_heating or self.stress != UPPER_CONVECTED):
            heat = 12 * self.Br * self.iRe * (V / R) ** 2 / y**6
            if self.s.elastic_heating and self.stress != UPPER_CONVECTED:
                q = (y**3 - 1 + (self.req / R) ** 3) ** (1 / 3) / y
                al = self.alphax if self.stress == QUADRATIC else 0.0
                more = 1 + al * (q**4 + 2 / q**2 - 3)
                heat = heat + 2 * self.Br * self.iCa / y**3 * V / R * (q**-2 - q**4) * more
        out = flow + self.Fo / R**2 * x1**4 / L**2 * dd / 4 + heat
        out[0] = 0.0
        return out

    def acceleration(self, R, V, P, Pdot, S, Sdot, A):
        p = P - self.iWe / R + S
        pdot = Pdot + self.iWe * V / R**2 + Sdot
        if self.radial == RAYLEIGH_PLESSET:
            return (p - 1 - 1.5 * V**2) / R
        C, H, h = self.cstar, p - 1, 1.0
        factor = 1.0
        if self.radial in (ENTHALPY, GILMORE):
            sam, no = 1 + self.B, (self.n - 1) / self.n
            ratio = (p + self.B) / sam
            H, h = sam / no * (ratio**no - 1), ratio ** (-1 / self.n)
            if self.radial == GILMORE:
                C = np.sqrt(self.n * sam * ratio**no)
                if not self.s.gilmore_without_factor:
                    factor = 1 - V / C
        top = (1 + V / C) * H + R / C * h * pdot * factor - 1.5 * (1 - V / (3 * C)) * V**2
        return top / ((1 - V / C) * R + factor * A * h / C)

    def solve(self, times, rtol=1e-9, method="LSODA"):
        """R/R0 at ``times`` (s)."""
        n = 3 + self.N + self.M + self.C + (2 if self.stress == UPPER_CONVECTED else 0)
        X = np.zeros(n)
        X[0], X[2] = 1.0, self.pg + self.pv
        X[3 + self.N : 3 + self.N + self.M] = 1.0
        X[3 + self.N + self.M : 3 + self.N + self.M + self.C] = self.kv0
        t = np.asarray(times) / self.t0
        jac = differenced(self.rhs)
        s = solve_ivp(self.rhs, (0, t[-1]), X, method, rtol=rtol, atol=rtol * 1e-3, t_eval=t, jac=jac)
        assert s.success, s.message
        return s.y[0]
