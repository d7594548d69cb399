"""The bubble with every option: vapour, conducting medium, memory, shear thinning, enthalpy and Gilmore equations.

State rows: Kirchhoff temperatures τ of the gas (mT), mole fractions Y = 1 − χ of the non-condensible gas (mY),
temperatures θ_m − 1 of the medium (mM), the wall's τ_w where the medium conducts (an algebraic unknown: RODAS5P
integrates the index-1 system as it stands), likewise Y_w where vapour crosses the wall at a finite rate, memory
variables (q), V, u. Notation and units as in :mod:`equations`.

Gas and vapour. Both have the same κ, hence the same molar heat capacity, and with the molar-average velocity u* the
energy equation is that of a pure gas (diffusion carries no net enthalpy):
    u*/R = (κ−1)/κ E τ' − y π̇/(3κ),     τ̇ = −(u*/R − yV) τ' + (κ−1)/κ kθ (π̇ + E ∇²τ)
    Ẏ = −(u*/R − yV) Y' + D/R² (∇²Y + (b−1) θ'Y'/θ),   D = D_v (p_∞/p)^a θ^b      (Fick's law)
    π̇ = 3(κ−1) E τ'_w − 3κ V − 3κ D_w/R² Y'_w/Y_w,     Y_w = 1 − p_sat(T_w)/p
which is Prosperetti's ṗ_b with vapour transport, R_v/R_mix · dC/(1−C) being −dY/Y. The non-condensible gas has the
density p Y/(R_a T), linear in p at the wall too, so p follows from its mass as in :mod:`equations`.
A driven bubble becomes nearly all vapour (Y about 1e-6), hence Y and not χ as the unknown. Its growth has a solution
that a grid can hold only with a = 1, as kinetic theory has it: at constant D, Y_w would be of order exp(−Ṙ R/D).
Finite rate (Hertz–Knudsen): ṁ = α (p_sat(T_w) − (1−Y_w) p)/√(2π R_v T_w) per area evaporates in place of what keeps
Y_w = 1 − p_sat/p, its limit for large α, and is what diffuses away:
    D_w Y'_w + α √(R_v T_w/2π) R Y_w (p_sat/p − 1 + Y_w) = 0

Medium (x = r/R ≥ 1, on a rational Chebyshev grid):  θ̇_m = V(x − x⁻²) θ_m' + D_m/R² ∇²θ_m + 12 ν V² x⁻⁶/(c_p T_∞)
(ν that of −4νV in J, whatever it depends on: all the work of this stress is heat, none of that of the memory's).
Wall: K_m θ_m' = K_∞ τ'_w + latent heat of the evaporating flux.

Radial: enthalpy form and Gilmore with the Tait liquid, ρ = ((p+B)/(p_∞+B))^{1/n}:
    H = ∫_{p_∞+p_f}^{p_w} dp/ρ,   Keller–Miksis: c constant;   Gilmore: C² = c² + (n−1)H and (R/C)(1−Ṙ/C) Ḣ.

Plane at the distance h: the pressure of the image, ±ρ/(2h) d(R²Ṙ)/dt (+ rigid, − free), adds to that far away. In V and
R it is ±ρ R/(2h) (R²V̇ + 3Ṙ²).

The unknowns of the fields τ, Y and θ_m know of each other only through a few numbers: the *border*, which is τ_w, Y_w,
the memory, V, u, and sums over the nodes (:data:`rows.SUMS` at most): the interior's share in τ'_w, in ⟨Y/θ⟩ and in
Y'_w. Here are the border's equations; those of the fields are in :mod:`fields`.

Matrix. It is extended by the sums, unknowns without a rate: rows and columns are the fields τ, Y and θ_m, then the
border, which begins with the sums. τ, Y and θ_m fill blocks of their own, Y's rows also the columns of τ, and all else
is zero but for the border. Elimination in this order fills nothing in.

Sources: Prosperetti (1991); Estrada et al. (2018); Warnez & Johnsen (2015); Prosperetti & Lezzi (1986); Gilmore (1952).
"""

from functools import cache

import numba as nb
import numpy as np

from en4dvar.plumbing.compiled import called
from en4dvar_bubble.solver import rows
from en4dvar_bubble.solver.arrays import Dims, IntArray
from en4dvar_bubble.solver.lanes import absolute, driving, exp, load, log, lookup, maximum, splat, sqrt, store
from en4dvar_bubble.solver.tiles import kept_tiles, whole


@nb.njit
def sums(dims):
    """How many sums over the nodes are in the border."""
    return rows.SUMS if dims.vapour else 2 if dims.gas else 0


@called
def _contents(border, V, u, outward, eq, par, shared, out):
    """Pressure and π̇ by the interior's share ``outward`` in θ_m'; writes what fields read and the wall's residuals."""
    mT, mY, mM, wall, kinetic = eq.dims.gas, eq.dims.vapour, eq.dims.medium, eq.dims.wall, eq.dims.kinetic
    ops, kappa, zero = eq.gas, load(par, rows.KAPPA), splat(0.0)
    if mT == 0:
        return exp(load(par, rows.LOG_GAS) - kappa * u * 3.0), kappa * V * (-3.0)
    at, a = sums(eq.dims), load(par, rows.SLOPE)
    tau_w = load(border, at) if wall else zero
    k_w = sqrt(maximum(a * tau_w * 2.0 + 1.0, 1e-12))
    theta_w = tau_w * 2.0 / (k_w + 1.0) + 1.0
    slope_w = load(border, rows.SLOPE_SUM) + tau_w * ops[mT, mT]
    interior = load(border, rows.CONTENT_SUM)
    at_wall = ops[2 * mT + 2, mT] / theta_w
    content = exp(load(par, rows.LOG_GAS) - u * 3.0)
    per_area = exp(u * (-2.0))
    saturation = zero
    if mY:
        saturation = load(par, rows.SATURATION) * exp(-(load(par, rows.SATURATION_T) / theta_w))
    p = (content + saturation * at_wall) / (interior + at_wall)
    gas_w = load(border, at + wall) if kinetic else zero
    if kinetic:
        p = content / (interior + gas_w * at_wall)
    E = load(par, rows.CONDUCTION) / p * per_area
    rate = (kappa - 1.0) * E * slope_w * 3.0 - kappa * V * 3.0
    flux = zero
    if mY:
        if not kinetic:  # 1 − p_sat/p without the cancellation where the bubble is nearly all vapour
            gas_w = (content - saturation * interior) / (content + saturation * at_wall)
        dilution = exp(load(par, rows.DIFFUSION_P) * log(load(par, rows.AMBIENT) / p))
        diffusion = load(par, rows.DIFFUSION) * per_area
        at_T = exp(load(par, rows.DIFFUSION_T) * log(theta_w))
        dilution = dilution + load(par, rows.SMEARED) * absolute(V) / diffusion
        inward = -(load(border, rows.VAPOUR_SUM) + gas_w * ops[mT, mT]) * dilution * at_T
        flux = inward / gas_w
        if kinetic:
            crossing = load(par, rows.CROSSING) * sqrt(theta_w) * exp(-u) / diffusion
            store(out, at + wall, crossing * gas_w * (saturation / p - 1.0 + gas_w) - inward)
        rate = rate + kappa * diffusion * flux * 3.0
        store(shared, rows.DIFFUSE, diffusion * dilution)
        store(shared, rows.GAS_WALL, gas_w)
    store(shared, rows.CONDUCT, E)
    store(shared, rows.RATE, rate)
    store(shared, rows.DRIFT, rate / (kappa * 3.0) + V)
    store(shared, rows.TAU_WALL, tau_w)
    if wall:
        hot = theta_w - 1.0
        store(shared, rows.FLOW, V)
        store(shared, rows.SPREAD, load(par, rows.MEDIUM_D) * per_area)
        store(shared, rows.HOT, hot)
        outside = load(par, rows.MEDIUM_K) * (outward + hot * eq.medium[mM, mM])
        store(out, at, outside - slope_w - load(par, rows.LATENT) * p / theta_w * flux)
    return p, rate


@called
def border_rates(border, t, outward, eq, loaded, shared, out):
    """Rates of the border's unknowns to ``out``, the residuals of its algebraic equations in the rows of τ_w and Y_w;
    what the fields read to ``shared``. ``outward``: see :func:`_contents`.
    """
    dims = eq.dims
    wall, q, radial = dims.wall, dims.memory, dims.radial
    par, span, viscous_span, reading = loaded.par, eq.elastic_span, eq.viscous_span, eq.reading
    oS = sums(eq.dims) + wall + dims.kinetic
    V = load(border, oS + q)
    u = load(border, oS + q + 1)
    p, rate = _contents(border, V, u, outward, eq, par, shared, out)

    x = u - load(par, rows.LOG_R0)
    J, Jx, _ = lookup(loaded.elastic, load(par, rows.TABLE), span, x)
    J_rate = Jx * V
    for j in range(q):
        s = load(border, oS + j)
        at = load(par, rows.MEMORY + rows.PER_MEMORY * j + 2)
        stiffness, _, _ = lookup(eq.memory, at, span, x)
        rest, _, _ = lookup(eq.memory, at + span[3] * 8.0, span, x)
        convection = load(par, rows.MEMORY + rows.PER_MEMORY * j + 1)
        change = (rest - s) / load(par, rows.MEMORY + rows.PER_MEMORY * j) + V * (convection * s + stiffness)
        store(out, oS + j, change)
        J = J + s
        J_rate = J_rate + change
    nu = load(par, rows.VISCOSITY)
    nu_V = nu  # of νV by V
    if dims.shear:
        z = maximum(log(maximum(absolute(V) * 1e6, 1e-300)), viscous_span[0])
        nu, nu_z, _ = lookup(eq.viscous, load(par, rows.VISCOUS_TABLE), viscous_span, z)
        nu_V = nu + nu_z
    if dims.strain:
        nu, nu_x, _ = lookup(eq.viscous, load(par, rows.VISCOUS_TABLE), viscous_span, x)
        nu_V = nu
        J_rate = J_rate - nu_x * V * V * 4.0
    dashpot, dashpot_V = nu * V * 4.0, nu_V * 4.0
    if wall:
        store(shared, rows.HEAT, load(par, rows.HEATING) * nu * V * V)

    R = exp(u)
    ic = load(par, rows.INVERSE_C)
    when = load(t, 0)
    if reading != rows.INSTANTANEOUS:
        when = when + R * ic
    f, g, _ = driving(when, eq, par)
    surface = load(par, rows.SURFACE) / R
    wall_pressure = p + load(par, rows.VAPOUR) - surface + J - dashpot
    wall_slope = p * rate + surface * V + J_rate
    Rdot = R * V
    if reading == rows.RETARDED:
        g = splat(0.0)
    elif reading == rows.AS_PRINTED:
        g = g * (Rdot * ic + 1.0)
    ambient = load(par, rows.AMBIENT)
    weight = splat(1.0)
    damping = splat(1.0)
    if radial == rows.PRESSURE:
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
        if radial == rows.GILMORE:
            ic = 1.0 / sqrt(maximum(1.0 / (ic * ic) + (n - 1.0) * H, 1e-12))
            weight = 1.0 - Rdot * ic
    mach = Rdot * ic
    Ric = R * ic * weight
    numerator = Rdot * Rdot * (mach * 1.5 - 2.5) + (mach + 1.0) * H + Ric * H_slope
    image = R * load(par, rows.IMAGE)
    numerator = numerator - image * Rdot * Rdot * 3.0
    store(out, oS + q, numerator / (R * R * (1.0 - mach + image) + dashpot_V * Ric * damping))
    store(out, oS + q + 1, V)


@nb.njit
def begins(dims):
    """Where the rows of Y, of θ_m and of the border begin: each with a tile of its own."""
    vapour = whole(dims.gas)
    medium = vapour + whole(dims.vapour)
    return vapour, medium, medium + whole(dims.medium)


def pattern(dims: Dims) -> np.ndarray:
    """(size, size): where the extended matrix and its factors may differ from zero."""
    gas, vapour = dims.gas, dims.gas + dims.vapour
    fields, kept = vapour + dims.medium, sums.py_func(dims)
    size = fields + kept + dims.wall + dims.kinetic + dims.memory + 2
    full = np.zeros((size, size), dtype=bool)
    full[:gas, :gas] = full[gas:vapour, :vapour] = full[vapour:fields, vapour:fields] = True
    full[:vapour, fields:] = full[vapour:fields, fields + kept :] = full[fields:, fields:] = True
    reach = {rows.SLOPE_SUM: (0, gas), rows.CONTENT_SUM: (0, vapour), rows.VAPOUR_SUM: (gas, vapour)}
    for row in range(kept):
        full[fields + row, slice(*reach[row])] = True
    if dims.wall:
        full[fields + kept, vapour:fields] = True
    return full


def places(dims: Dims) -> IntArray:
    """The place of each row of the :func:`pattern` among whole tiles."""
    border = sums.py_func(dims) + dims.wall + dims.kinetic + dims.memory + 2
    counts = dims.gas, dims.vapour, dims.medium, border
    first = 0, *begins.py_func(dims)
    return np.concatenate([np.arange(begin, begin + count) for begin, count in zip(first, counts, strict=True)])


@cache
def tiles(dims: Dims) -> tuple[IntArray, IntArray]:
    """``where`` of the matrix and the places of the unknowns that have a rate, see :mod:`tiles`."""
    every, fields = places(dims), dims.gas + dims.vapour + dims.medium
    with_rate = np.delete(every, np.arange(fields, fields + sums.py_func(dims)))
    return kept_tiles(pattern(dims), every), with_rate
