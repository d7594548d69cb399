"""The bubble with every option: vapour, conducting medium, memory, shear thinning, enthalpy and Gilmore equations.

State rows: Kirchhoff temperatures τ of the gas (mT), mole fractions Y = 1 − χ of the non-condensible gas (mY),
temperatures θ_m − 1 of the medium (mM), the wall's τ_w where the medium conducts (an algebraic unknown: RODAS5P
integrates the index-1 system as it stands), memory variables (q), V, u. Notation and units as in :mod:`equations`. The
Jacobian is by one-sided differences. The functions are long because a split changes which multiply–adds are fused, and
with them the last digit, which differences and bounces make a visible one.

Gas and vapour. Both have the same κ, hence the same molar heat capacity, and with the molar-average velocity u* the
energy equation is that of a pure gas (diffusion carries no net enthalpy):
    u*/R = (κ−1)/κ E τ' − y π̇/(3κ),     τ̇ = −(u*/R − yV) τ' + (κ−1)/κ kθ (π̇ + E ∇²τ)
    Ẏ = −(u*/R − yV) Y' + D/R² (∇²Y + (b−1) θ'Y'/θ),   D = D_v (p_∞/p)^a θ^b      (Fick's law)
    π̇ = 3(κ−1) E τ'_w − 3κ V − 3κ D_w/R² Y'_w/Y_w,     Y_w = 1 − p_sat(T_w)/p
which is Prosperetti's ṗ_b with vapour transport, R_v/R_mix · dC/(1−C) being −dY/Y. The non-condensible gas has the
density p Y/(R_a T), linear in p at the wall too, so p follows from its mass as in :mod:`equations`.
A driven bubble becomes nearly all vapour (Y about 1e-6), hence Y and not χ as the unknown. Its growth has a solution
that a grid can hold only with a = 1, as kinetic theory has it: at constant D, Y_w would be of order exp(−Ṙ R/D).

Medium (x = r/R ≥ 1, on a rational Chebyshev grid):  θ̇_m = V(x − x⁻²) θ_m' + D_m/R² ∇²θ_m + 12 ν V² x⁻⁶/(c_p T_∞)
Wall: K_m θ_m' = K_∞ τ'_w + latent heat of the evaporating flux.

Radial: enthalpy form and Gilmore with the Tait liquid, ρ = ((p+B)/(p_∞+B))^{1/n}:
    H = ∫_{p_∞+p_f}^{p_w} dp/ρ,   Keller–Miksis: c constant;   Gilmore: C² = c² + (n−1)H and (R/C)(1−Ṙ/C) Ḣ.

Sources: Prosperetti (1991); Estrada et al. (2018); Warnez & Johnsen (2015); Prosperetti & Lezzi (1986); Gilmore (1952).
"""

from __future__ import annotations

import numba as nb

from en4dvar_bubble.solver import rows
from en4dvar_bubble.solver.lanes import absolute, exp, load, log, maximum, splat, sqrt, store
from en4dvar_bubble.solver.lookup import driving, lookup
from en4dvar_bubble.solver.rows import AS_PRINTED, GILMORE, INSTANTANEOUS, MEMORY, PER_MEMORY, PRESSURE, RETARDED

_DELTA = 1e-7


@nb.njit
def _derivative(y, first, count, wall, matrix, row):
    """Row ``row`` of a collocation matrix times the unknowns ``first … first+count−1`` and the wall value."""
    total = wall * matrix[row, count]
    for j in range(count):
        total = total + load(y, first + j) * matrix[row, j]
    return total


@nb.njit
def _gas_and_medium(y, eq, par, V, u, out):
    """Pressure and π̇; writes the rates of gas, vapour and medium and the residual of the wall."""
    mT, mY, mM, wall, _, _, _ = eq.dims
    ops, medium = eq.gas, eq.medium
    kappa = load(par, rows.KAPPA)
    if mT == 0:
        return exp(load(par, rows.LOG_GAS) - kappa * u * 3.0), kappa * V * (-3.0)
    oY, oM = mT, mT + mY
    oW = oM + mM
    k1 = (kappa - 1.0) / kappa
    a = load(par, rows.SLOPE)
    weights = ops[2 * mT + 2]
    zero = splat(0.0)
    tau_w = load(y, oW) if wall else zero
    k_w = sqrt(maximum(a * tau_w * 2.0 + 1.0, 1e-12))
    theta_w = tau_w * 2.0 / (k_w + 1.0) + 1.0
    saturation = zero
    if mY:
        saturation = load(par, rows.SATURATION) * exp(-(load(par, rows.SATURATION_T) / theta_w))
    at_wall = weights[mT] / theta_w
    interior = zero
    for i in range(mT):
        tau = load(y, i)
        k = sqrt(maximum(a * tau * 2.0 + 1.0, 1e-12))
        share = weights[i] / (tau * 2.0 / (k + 1.0) + 1.0)
        if mY:
            share = share * load(y, oY + i)
        interior = interior + share
    content = exp(load(par, rows.LOG_GAS) - u * 3.0)
    p = (content + saturation * at_wall) / (interior + at_wall)
    per_area = exp(u * (-2.0))
    E = load(par, rows.CONDUCTION) / p * per_area
    slope_w = _derivative(y, 0, mT, tau_w, ops, mT)
    rate = (kappa - 1.0) * E * slope_w * 3.0 - kappa * V * 3.0
    gas_w = zero
    flux = zero
    diffusion = zero
    power = load(par, rows.DIFFUSION_T)
    if mY:
        # 1 − p_sat/p without the cancellation where the bubble is nearly all vapour
        gas_w = (content - saturation * interior) / (content + saturation * at_wall)
        dilution = exp(load(par, rows.DIFFUSION_P) * log(load(par, rows.AMBIENT) / p))
        diffusion = load(par, rows.DIFFUSION) * per_area * dilution
        at_T = exp(power * log(theta_w))
        flux = -(_derivative(y, oY, mY, gas_w, ops, mT) / gas_w) * dilution * at_T
        rate = rate + kappa * load(par, rows.DIFFUSION) * per_area * flux * 3.0
    for i in range(mT):
        tau = load(y, i)
        k = sqrt(maximum(a * tau * 2.0 + 1.0, 1e-12))
        theta = tau * 2.0 / (k + 1.0) + 1.0
        slope = _derivative(y, 0, mT, tau_w, ops, i)
        bend = _derivative(y, 0, mT, tau_w, ops, mT + 1 + i)
        drift = k1 * E * slope - (rate / (kappa * 3.0) + V) * ops[2 * mT + 1, i]
        store(out, i, k1 * k * theta * (rate + E * bend) - drift * slope)
        if mY:
            slope_y = _derivative(y, oY, mY, gas_w, ops, i)
            bend_y = _derivative(y, oY, mY, gas_w, ops, mT + 1 + i)
            spread_y = diffusion * exp(power * log(maximum(theta, 1e-12)))
            store(out, oY + i, spread_y * (bend_y + (power - 1.0) * slope / (k * theta) * slope_y) - drift * slope_y)
    if wall:
        hot = theta_w - 1.0
        spread = load(par, rows.MEDIUM_D) * per_area
        heating = load(par, rows.HEATING) * load(par, rows.VISCOSITY) * V * V
        for j in range(mM):
            x = medium[2 * mM + 1, j]
            slope = _derivative(y, oM, mM, hot, medium, j)
            bend = _derivative(y, oM, mM, hot, medium, mM + 1 + j)
            flow = V * (x - 1.0 / (x * x))
            store(out, oM + j, flow * slope + spread * bend + heating * (1.0 / x**6))
        outside = load(par, rows.MEDIUM_K) * _derivative(y, oM, mM, hot, medium, mM)
        store(out, oW, outside - slope_w - load(par, rows.LATENT) * p / theta_w * flux)
    return p, rate


@nb.njit
def general_rhs(y, t, eq, loaded, out):
    """Write dy/dt (n, 8) to ``out``; the wall's row holds the residual of its algebraic equation."""
    mT, mY, mM, wall, q, radial, shear = eq.dims
    par, span, viscous_span, reading = loaded.par, eq.elastic_span, eq.viscous_span, eq.reading
    oS = mT + mY + mM + wall
    V = load(y, oS + q)
    u = load(y, oS + q + 1)
    p, rate = _gas_and_medium(y, eq, par, V, u, out)

    x = u - load(par, rows.LOG_R0)
    J, Jx, _ = lookup(loaded.elastic, load(par, rows.TABLE), span, x)
    J_rate = Jx * V
    for j in range(q):
        s = load(y, oS + j)
        at = load(par, MEMORY + PER_MEMORY * j + 2)
        stiffness, _, _ = lookup(eq.memory, at, span, x)
        rest, _, _ = lookup(eq.memory, at + span[3] * 8.0, span, x)
        convection = load(par, MEMORY + PER_MEMORY * j + 1)
        change = (rest - s) / load(par, MEMORY + PER_MEMORY * j) + V * (convection * s + stiffness)
        store(out, oS + j, change)
        J = J + s
        J_rate = J_rate + change
    nu = load(par, rows.VISCOSITY)
    dashpot = nu * V * 4.0
    dashpot_V = nu * 4.0
    if shear:
        z = maximum(log(maximum(absolute(V) * 1e6, 1e-300)), viscous_span[0])
        at = load(par, rows.VISCOUS_TABLE)
        nu, nu_z, _ = lookup(eq.viscous, at, viscous_span, z)
        dashpot = nu * V * 4.0
        dashpot_V = (nu + nu_z) * 4.0

    R = exp(u)
    ic = load(par, rows.INVERSE_C)
    when = load(t, 0)
    if reading != INSTANTANEOUS:
        when = when + R * ic
    f, g, _ = driving(when, eq, par)
    surface = load(par, rows.SURFACE) / R
    wall_pressure = p + load(par, rows.VAPOUR) - surface + J - dashpot
    wall_slope = p * rate + surface * V + J_rate
    Rdot = R * V
    if reading == RETARDED:
        g = splat(0.0)
    elif reading == AS_PRINTED:
        g = g * (Rdot * ic + 1.0)
    ambient = load(par, rows.AMBIENT)
    weight = splat(1.0)
    damping = splat(1.0)
    if radial == PRESSURE:
        H = wall_pressure - ambient - f
        H_slope = wall_slope - g
    else:
        B = load(par, rows.TAIT_B)
        n = load(par, rows.TAIT_N)
        scale = 1.0 / (ambient + B)
        log_wall = log(maximum((wall_pressure + B) * scale, 1e-300))
        log_far = log(maximum((ambient + f + B) * scale, 1e-300))
        share = (n - 1.0) / n
        H = (exp(share * log_wall) - exp(share * log_far)) / (share * scale)
        damping = exp(-(log_wall / n))
        H_slope = wall_slope * damping - g * exp(-(log_far / n))
        if radial == GILMORE:
            ic = 1.0 / sqrt(maximum(1.0 / (ic * ic) + (n - 1.0) * H, 1e-12))
            weight = 1.0 - Rdot * ic
    mach = Rdot * ic
    Ric = R * ic * weight
    numerator = Rdot * Rdot * (mach * 1.5 - 2.5) + (mach + 1.0) * H + Ric * H_slope
    store(out, oS + q, numerator / (R * R * (1.0 - mach) + dashpot_V * Ric * damping))
    store(out, oS + q + 1, V)


@nb.njit
def general_jacobian(y, t, eq, loaded, w):
    """Write dy/dt to ``f`` (n, 8) of the workspace, ∂f/∂y to ``jac`` (row i·n+j) and ∂f_V/∂t to ``dt`` (1, 8), by
    differences.
    """
    n, first_vapour = len(w.f), eq.dims.gas
    shifted, changed = w.stage, w.y_new  # not in use yet
    general_rhs(y, t, eq, loaded, w.f)
    for i in range(n):
        store(shifted, i, load(y, i))
    for j in range(n):
        value = load(y, j)
        floor_j = 0.01 if j == n - 2 else 1e-6 if first_vapour <= j < first_vapour + eq.dims.vapour else 1.0
        delta = _DELTA * maximum(absolute(value), floor_j)
        store(shifted, j, value + delta)
        delta = load(shifted, j) - value
        general_rhs(shifted, t, eq, loaded, changed)
        inverse = 1.0 / delta
        for i in range(n):
            store(w.jac, i * n + j, (load(changed, i) - load(w.f, i)) * inverse)
        store(shifted, j, value)
    now = load(t, 0)
    store(w.dt, 0, splat(0.0))
    if eq.driving_span[1] > eq.driving_span[0]:
        store(t, 0, now + _DELTA)
        general_rhs(y, t, eq, loaded, changed)
        store(w.dt, 0, (load(changed, n - 2) - load(w.f, n - 2)) / (load(t, 0) - now))
        store(t, 0, now)
