"""One step of RODAS5P for all lanes: Jacobian, factorisation, stages, error."""

import numba as nb
from numba.core.types import BaseTuple, NoneType
from numba.extending import overload

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


def _is_general(eq):
    """Whether a type of :class:`arrays.Equations` is that of the equations with every option."""
    return isinstance(eq.types[eq.fields.index("nodes")], NoneType)


def _is_unrolled(eq):
    """Whether it is that of the paper's equations with few nodes."""
    return isinstance(eq.types[eq.fields.index("size")], BaseTuple)


def _unrolled(lanes, eq, w):
    """:func:`_linearise` of the paper's equations with few nodes."""
    jacobian(lanes.y, lanes.t, eq, lanes.loaded, w)
    n = len(w.f)
    inverse_h = 1.0 / load(lanes.h, 0)
    for i in range(n * n):
        store(w.jac, i, -load(w.jac, i))
    for i in range(n):
        store(w.jac, i * n + i, load(w.jac, i * n + i) + inverse_h * (1.0 / _GAMMA))
    _factorise(w.jac, eq.size)


@called
def _dense(lanes, eq, w):
    """:func:`_linearise` of the paper's equations with many."""
    jacobian(lanes.y, lanes.t, eq, lanes.loaded, w)
    n = len(w.f)
    for i in range(len(w.tiles)):
        store(w.tiles, i, 0.0)
    for i in range(n):
        for j in range(n):
            store(w.tiles, place(eq.where, i, j), -load(w.jac, i * n + j))
    factorise(w.tiles, lanes.h, eq.where, eq.places, (0, 0))


@called
def _general(lanes, eq, w):
    """:func:`_linearise` of the equations with every option."""
    general_jacobian(lanes.y, lanes.t, eq, lanes.loaded, w)
    factorise(w.tiles, lanes.h, eq.where, eq.places, _algebraic_rows(eq))


def _linearise(lanes, eq, w):
    """dy/dt to ``f``, ∂f_V/∂t to ``dt``, factors of 1/(hγ) − ∂f/∂y (algebraic rows: −∂f/∂y) to ``jac`` or ``tiles``."""


@overload(_linearise, jit_options={"forceinline": True})
def _choose_matrix(lanes, eq, w):
    if _is_general(eq):
        return lambda lanes, eq, w: _general(lanes, eq, w)
    return _unrolled if _is_unrolled(eq) else lambda lanes, eq, w: _dense(lanes, eq, w)


def _substitute(eq, w, row):
    """Solve for the stage in rows ``row … row+n−1`` of ``k``."""


@overload(_substitute, jit_options={"forceinline": True})
def _choose_solve(eq, w, row):
    if _is_unrolled(eq):
        return lambda eq, w, row: _solve(w.jac, eq.size, w.k, row)
    return lambda eq, w, row: solve(w.tiles, eq.where, eq.places, w.extended, w.k, row)


def _rhs(y, t, eq, loaded, w):
    """The right-hand side alone, to ``f``."""


@overload(_rhs, jit_options={"forceinline": True})
def _choose_rhs(y, t, eq, loaded, w):
    if _is_general(eq):
        return lambda y, t, eq, loaded, w: general_rhs(y, t, eq, loaded, w)
    return rhs


@inlined
def _algebraic_rows(eq):
    """First and last + 1 of the rows of the wall's temperature and gas, which have algebraic equations."""
    first = eq.dims.gas + eq.dims.vapour + eq.dims.medium
    return first, first + eq.dims.wall + eq.dims.kinetic


@nb.njit(inline="always")
def attempt(lanes, eq, w):
    """The stages of one step of all lanes to ``k``, the argument of the last to ``stage``."""
    algebraic = _algebraic_rows(eq)
    _linearise(lanes, eq, w)
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
            _rhs(w.stage, w.t_stage, eq, lanes.loaded, w)
        for i in range(n):
            value = splat(0.0)
            if i < algebraic[0] or i >= algebraic[1]:
                for r in range(s):
                    value = value + load(w.k, r * n + i) * _C[s, r]
            store(w.k, s * n + i, load(w.f, i) + value * inverse_h)
        store(w.k, s * n + fast_row, load(w.k, s * n + fast_row) + slope_t * _D[s])
        _substitute(eq, w, s * n)


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
