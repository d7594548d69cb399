"""One step of RODAS5P for all lanes: Jacobian, factorisation, stages, error."""

import numba as nb

from en4dvar.plumbing.compiled import called, inlined
from en4dvar_bubble.solver import rodas5p
from en4dvar_bubble.solver.equations import jacobian, rhs
from en4dvar_bubble.solver.fields import general_jacobian, general_rhs
from en4dvar_bubble.solver.lanes import absolute, exp, load, log, maximum, splat, sqrt, store
from en4dvar_bubble.solver.rows import INVERSE_C
from en4dvar_bubble.solver.tiles import factorise, place, solve

_A, _C, _ALPHA, _D, _H = rodas5p.A, rodas5p.C, rodas5p.ALPHA, rodas5p.D, rodas5p.H
_GAMMA, _STAGES = rodas5p.GAMMA, rodas5p.STAGES
_EXPONENT = 1.0 / rodas5p.ORDER
LEAST_ERROR = 1e-8  # the step grows as if the error were not smaller


@inlined
def _factorise(a, size):
    """LU without pivoting, in place, of rows i·n+j whose diagonal dominates; that is replaced by its inverse."""
    n = len(size)
    for k in range(n):
        pivot = 1.0 / load(a, k * n + k)
        store(a, k * n + k, pivot)
        for i in range(k + 1, n):
            factor = load(a, i * n + k) * pivot
            store(a, i * n + k, factor)
            for j in range(k + 1, n):
                store(a, i * n + j, load(a, i * n + j) - factor * load(a, k * n + j))


@inlined
def _solve(a, size, b, row):
    """Solve in place for the right-hand side in rows ``row … row+n−1`` of ``b``."""
    n = len(size)
    for i in range(1, n):
        total = load(b, row + i)
        for j in range(i):
            total = total - load(a, i * n + j) * load(b, row + j)
        store(b, row + i, total)
    for i in range(n - 1, -1, -1):
        total = load(b, row + i)
        for j in range(i + 1, n):
            total = total - load(a, i * n + j) * load(b, row + j)
        store(b, row + i, total * load(a, i * n + i))


# Which equations these are, the compiler knows by what is None of :class:`arrays.Equations`: it leaves out what stands
# under ``x is not None`` where the argument x is None.


@inlined
def _linearise(nodes, size, medium, where, lanes, eq, w):
    """dy/dt to ``f``, ∂f_V/∂t to ``dt``, factors of 1/(hγ) − ∂f/∂y (algebraic rows: −∂f/∂y) to ``jac`` or ``tiles``."""
    n = len(w.f)
    if medium is not None:
        general_jacobian(lanes.y, lanes.t, eq, lanes.loaded, w)
        factorise(w.tiles, lanes.h, where, eq.places, _algebraic_rows(eq))
    if nodes is not None:
        jacobian(lanes.y, lanes.t, eq, lanes.loaded, w)
        if where is not None:
            for i in range(len(w.tiles)):
                store(w.tiles, i, 0.0)
            for i in range(n):
                for j in range(n):
                    store(w.tiles, place(where, i, j), -load(w.jac, i * n + j))
            factorise(w.tiles, lanes.h, where, eq.places, (0, 0))
    if size is not None:
        inverse_h = 1.0 / load(lanes.h, 0)
        for i in range(n * n):
            store(w.jac, i, -load(w.jac, i))
        for i in range(n):
            store(w.jac, i * n + i, load(w.jac, i * n + i) + inverse_h * (1.0 / _GAMMA))
        _factorise(w.jac, size)


@inlined
def _substitute(size, where, eq, w, row):
    """Solve for the stage in rows ``row … row+n−1`` of ``k``."""
    if size is not None:
        _solve(w.jac, size, w.k, row)
    if where is not None:
        solve(w.tiles, where, eq.places, w.extended, w.k, row)


@inlined
def _rhs(nodes, medium, y, t, eq, loaded, w):
    """The right-hand side alone, to ``f``."""
    if nodes is not None:
        rhs(y, t, eq, loaded, w)
    if medium is not None:
        general_rhs(y, t, eq, loaded, w)


@inlined
def _algebraic_rows(eq):
    """First and last + 1 of the rows of the wall's temperature and gas, which have algebraic equations."""
    first = eq.dims.gas + eq.dims.vapour + eq.dims.medium
    return first, first + eq.dims.wall + eq.dims.kinetic


@nb.njit(inline="always")
def attempt(lanes, eq, w):
    """The stages of one step of all lanes to ``k``, the argument of the last to ``stage``."""
    algebraic = _algebraic_rows(eq)
    _linearise(eq.nodes, eq.size, eq.medium, eq.where, lanes, eq, w)
    n = len(w.f)
    fast_row = n - 2  # V, the only row with an explicit time dependence
    step = load(lanes.h, 0)
    inverse_h = 1.0 / step
    now = load(lanes.t, 0)
    slope_t = load(w.dt, 0) * step
    for s in range(_STAGES):
        if s > 0:
            for i in range(n):
                value = load(lanes.y, i)
                for r in range(s):
                    value = value + load(w.k, r * n + i) * _A[s, r]
                store(w.stage, i, value)
            store(w.t_stage, 0, now + step * _ALPHA[s])
            _rhs(eq.nodes, eq.medium, w.stage, w.t_stage, eq, lanes.loaded, w)
        for i in range(n):
            value = splat(0.0)
            if i < algebraic[0] or i >= algebraic[1]:
                for r in range(s):
                    value = value + load(w.k, r * n + i) * _C[s, r]
            store(w.k, s * n + i, load(w.f, i) + value * inverse_h)
        store(w.k, s * n + fast_row, load(w.k, s * n + fast_row) + slope_t * _D[s])
        _substitute(eq.size, eq.where, eq, w, s * n)


@called
def judge(lanes, shear, tolerances, w):
    """The new state to ``y_new``, error and wall Mach number to ``norm``."""
    n = len(w.f)
    inverse_h = 1.0 / load(lanes.h, 0)
    total = splat(0.0)
    last = (_STAGES - 1) * n
    for i in range(n):
        old = load(lanes.y, i)
        error = load(w.k, last + i)
        new = load(w.stage, i) + error
        store(w.y_new, i, new)
        size = maximum(absolute(old), absolute(new))
        if shear and i == n - 2:
            # At a bounce V passes the viscosity's knee in 1e-12 µs; on the scale √|V̇| nothing happens.
            size = maximum(size, sqrt(absolute(new - old) * inverse_h))
        ratio = error / (size * tolerances[1, i] + tolerances[0, i])
        total = total + ratio * ratio
    error_norm = sqrt(total * (1.0 / n))
    store(w.norm, 0, error_norm)
    store(w.norm, 1, exp(log(maximum(error_norm, LEAST_ERROR)) * _EXPONENT))
    mach = absolute(load(w.y_new, n - 2)) * exp(load(w.y_new, n - 1)) * load(lanes.loaded.par, INVERSE_C)
    store(w.norm, 2, mach)


@called
def interpolant(w):
    """Rows 3n of the dense-output polynomial (K1, K2, K3) of all lanes, to ``dense``."""
    n = len(w.f)
    for r in range(3):
        for i in range(n):
            value = splat(0.0)
            for s in range(_STAGES):
                value = value + load(w.k, s * n + i) * _H[r, s]
            store(w.dense, r * n + i, value)
