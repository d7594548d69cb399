"""The equations of the paper's bubble and their analytic Jacobian, eight members at a time.

Keller–Miksis in pressure, an elastic solid with a Newtonian dashpot, polytropic gas or heat equation with a cold
wall. Every other option is in :mod:`general`, which must agree with this module where they overlap. Arguments and their
layout: :mod:`arrays`.

State rows (n = m + 2): Kirchhoff temperatures τ_1…τ_m, V = Ṙ/R (1/µs), u = ln(R/µm). Units: µm, µs, pressures divided
by the density (µm²/µs²), so no other scaling is needed. In the logarithmic variables radius and pressure cannot
become negative.

Gas (Prosperetti 1991, homobaric): with θ = T/T_∞, k = K/K_∞ = a θ + (1−a), τ = ∫ k dθ, E = K_∞T_∞/(p R²), ' = d/dy,
    τ̇_i = y_i V τ'_i + (κ−1)/κ E [k_iθ_i ∇²τ_i − τ'_i²] + [(κ−1)/κ k_iθ_i + y_i τ'_i/(3κ)] π̇
    π̇  = d ln p/dt = 3(κ−1) E τ'_wall − 3κ V
The pressure itself is not integrated: it follows from the mass of gas, p = M e^{−3u}/⟨1/θ⟩, so mass is conserved to
rounding at every instant. Integrating p instead leaks gas through a violent collapse (0.35 % of R with 400
finite-difference nodes).

Radial motion (Keller & Miksis 1980; the paper's eq. 1), Mach number m = Ṙ/c:
    [R²(1−m) + 4νR/c] V̇ = Ṙ²(−5/2 + 3m/2) + (1+m) P + (R/c) dP/dt|_{V̇=0},   P = p_b − p_∞ − p_f − σ/R + J_e − 4νV
"""

from en4dvar.plumbing.compiled import inlined
from en4dvar_bubble.solver import rows
from en4dvar_bubble.solver.lanes import driving, exp, load, lookup, maximum, splat, sqrt, store


@inlined
def products(y, first, count, matrix, work, at):
    """d/dy at the nodes and at the wall, then the Laplacian, of the unknowns ``first … first+count−1`` to ``work``,
    without what the wall adds. Returns d/dy at the wall.

    Four sums at a time, which do not wait for each other; the last ones may be repeated.
    """
    number = 2 * count + 1
    for i in range(0, number, 4):
        b, c, d = min(i + 1, number - 1), min(i + 2, number - 1), min(i + 3, number - 1)
        sum_a, sum_b, sum_c, sum_d = splat(0.0), splat(0.0), splat(0.0), splat(0.0)
        for j in range(count):
            value = load(y, first + j)
            sum_a = sum_a + value * matrix[i, j]
            sum_b = sum_b + value * matrix[b, j]
            sum_c = sum_c + value * matrix[c, j]
            sum_d = sum_d + value * matrix[d, j]
        store(work, at + i, sum_a)
        store(work, at + b, sum_b)
        store(work, at + c, sum_c)
        store(work, at + d, sum_d)
    return load(work, at + count)


@inlined
def _gas(y, nodes, par, ops, work):
    """Pressure p, π̇, E and wall gradient; rows of ``work``: k (0…), θ (m…), τ' (2m…, last at the wall), ∇²τ (3m+1…),
    ⟨1/θ⟩ (4m+1).
    """
    m = len(nodes)
    V = load(y, m)
    u = load(y, m + 1)
    kappa = load(par, rows.KAPPA)
    zero = splat(0.0)
    if m == 0:
        p = exp(load(par, rows.LOG_GAS) - kappa * u * 3.0)
        return p, kappa * V * (-3.0), zero, zero
    a = load(par, rows.SLOPE)
    weights = ops[2 * m + 2]
    inverse_mean = splat(weights[m])
    for i in range(m):
        tau = load(y, i)
        k = sqrt(maximum(a * tau * 2.0 + 1.0, 1e-12))
        theta = tau * 2.0 / (k + 1.0) + 1.0
        store(work, i, k)
        store(work, m + i, theta)
        inverse_mean = inverse_mean + weights[i] / theta
    wall = products(y, 0, m, ops, work, 2 * m)
    store(work, 4 * m + 1, inverse_mean)
    p = exp(load(par, rows.LOG_GAS) - u * 3.0) / inverse_mean
    E = load(par, rows.CONDUCTION) / p * exp(u * (-2.0))
    rate = (kappa - 1.0) * E * wall * 3.0 - kappa * V * 3.0
    return p, rate, E, wall


@inlined
def _motion(V, u, t, eq, loaded, p, rate):
    """V̇ and, for its derivatives: one over its factor, R, Ṙ/c, R/c; dp_f/dt, d²p_f/dt²; J_e' and J_e'' by ln λ; σ/R,
    4ν, P, dP/dt.
    """
    par, reading = loaded.par, eq.reading
    R = exp(u)
    ic = load(par, rows.INVERSE_C)
    mach = R * V * ic
    Ric = R * ic
    when = load(t, 0)
    if reading != rows.INSTANTANEOUS:
        when = when + Ric
    f, g, h = driving(when, eq, par)
    J, Jx, Jxx = lookup(loaded.elastic, load(par, rows.TABLE), eq.elastic_span, u - load(par, rows.LOG_R0))
    surface = load(par, rows.SURFACE) / R
    nu4 = load(par, rows.VISCOSITY) * 4.0
    P = p + load(par, rows.VAPOUR) - load(par, rows.AMBIENT) - f - surface + J - nu4 * V
    slope = p * rate + (surface + Jx) * V
    if reading == rows.INSTANTANEOUS:
        slope = slope - g
    elif reading == rows.AS_PRINTED:
        slope = slope - g * (mach + 1.0)
    numerator = R * R * V * V * (mach * 1.5 - 2.5) + (mach + 1.0) * P + Ric * slope
    inverse = 1.0 / (R * R * (1.0 - mach) + nu4 * Ric)
    return numerator * inverse, inverse, R, mach, Ric, g, h, Jx, Jxx, surface, nu4, P, slope


@inlined
def rhs(y, t, eq, loaded, w):
    """Write dy/dt (n, 8) to ``f`` of the workspace."""
    nodes, par, ops, work, out = eq.nodes, loaded.par, eq.gas, w.work, w.f
    m = len(nodes)
    p, rate, E, _wall = _gas(y, nodes, par, ops, work)
    V = load(y, m)
    u = load(y, m + 1)
    kappa = load(par, rows.KAPPA)
    k1 = (kappa - 1.0) / kappa
    for i in range(m):
        first = load(work, 2 * m + i)
        conduct = k1 * load(work, i) * load(work, m + i)
        radius = ops[2 * m + 1, i]
        drift = first * radius
        dtau = drift * V + E * (conduct * load(work, 3 * m + 1 + i) - k1 * first * first)
        store(out, i, dtau + (conduct + drift / (kappa * 3.0)) * rate)
    acceleration = _motion(V, u, t, eq, loaded, p, rate)[0]
    store(out, m, acceleration)
    store(out, m + 1, V)


@inlined
def jacobian(y, t, eq, loaded, w):
    """Write dy/dt to ``f`` of the workspace, ∂f/∂y to ``jac`` (row i·n+j) and ∂f_V/∂t, the only nonzero, to ``dt``."""
    nodes, par, ops, reading = eq.nodes, loaded.par, eq.gas, eq.reading
    work, out, jac, dt = w.work, w.f, w.jac, w.dt
    m = len(nodes)
    n = m + 2
    p, rate, E, wall = _gas(y, nodes, par, ops, work)
    V = load(y, m)
    u = load(y, m + 1)
    kappa = load(par, rows.KAPPA)
    k1 = (kappa - 1.0) / kappa
    heat = (kappa - 1.0) * 3.0 * E
    rate_u = heat * wall
    rate_V = kappa * (-3.0)
    zero = splat(0.0)
    acceleration, inverse, R, mach, Ric, g, h, Jx, Jxx, surface, nu4, P, slope = _motion(V, u, t, eq, loaded, p, rate)
    pressure_u = p * (-3.0)
    if m == 0:
        pressure_u = p * rate_V
        rate_u = zero
    P_u = pressure_u + surface + Jx
    slope_u = pressure_u * rate + p * rate_u + (Jxx - surface) * V
    slope_V = p * rate_V + surface + Jx
    ahead = mach + 1.0
    numerator_t = -(ahead * g)
    if reading == rows.INSTANTANEOUS:
        numerator_t = numerator_t - Ric * h
    else:
        P_u = P_u - g * Ric
    if reading == rows.AS_PRINTED:
        slope_u = slope_u - h * Ric * ahead - g * mach
        slope_V = slope_V - g * Ric
        numerator_t = numerator_t - Ric * h * ahead
    Rdot2 = R * R * V * V
    numerator_u = Rdot2 * (mach * 4.5 - 5.0) + mach * P + ahead * P_u + Ric * (slope + slope_u)
    numerator_V = R * R * V * (mach * 4.5 - 5.0) + Ric * P - ahead * nu4 + Ric * slope_V
    denominator_u = R * R * (2.0 - mach * 3.0) + nu4 * Ric
    denominator_V = -(R * R * Ric)
    store(out, m, acceleration)
    store(out, m + 1, V)
    row_V = m * n
    row_u = row_V + n
    store(jac, row_V + m, (numerator_V - acceleration * denominator_V) * inverse)
    store(jac, row_V + m + 1, (numerator_u - acceleration * denominator_u) * inverse)
    store(dt, 0, numerator_t * inverse)
    for j in range(m):
        store(jac, row_u + j, zero)
    store(jac, row_u + m, splat(1.0))
    store(jac, row_u + m + 1, zero)
    if m == 0:
        return

    a = load(par, rows.SLOPE)
    mean = load(work, 4 * m + 1)
    for j in range(m):  # ∂ln p/∂τ_j and ∂π̇/∂τ_j, kept in the rows that the sums below need
        k = load(work, j)
        theta = load(work, m + j)
        share = ops[2 * m + 2, j] / (k * theta * theta * mean)
        rate_j = heat * (ops[m, j] - share * wall)
        store(jac, row_V + j, (ahead * p * share + Ric * p * (share * rate + rate_j)) * inverse)
        store(work, 4 * m + 2 + j, share)
        store(work, 5 * m + 2 + j, rate_j)
    for i in range(m):
        k = load(work, i)
        theta = load(work, m + i)
        first = load(work, 2 * m + i)
        second = load(work, 3 * m + 1 + i)
        radius = ops[2 * m + 1, i]
        conduct = k1 * k * theta
        drift = first * radius
        coupling = conduct + drift / (kappa * 3.0)
        diffusion = E * (conduct * second - k1 * first * first)
        store(out, i, drift * V + diffusion + coupling * rate)
        on_first = V * radius - k1 * E * first * 2.0 + rate * radius / (kappa * 3.0)
        on_second = conduct * E
        for j in range(m):
            value = on_first * ops[i, j] + on_second * ops[m + 1 + i, j]
            value = value - load(work, 4 * m + 2 + j) * diffusion + coupling * load(work, 5 * m + 2 + j)
            if i == j:
                value = value + k1 * (a * theta + k) / k * (E * second + rate)
            store(jac, i * n + j, value)
        store(jac, i * n + m, drift + coupling * rate_V)
        store(jac, i * n + m + 1, diffusion + coupling * rate_u)
