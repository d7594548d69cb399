"""One bubble of any physics for general-purpose integrators, which ask for one right-hand side at a time.

Right-hand side and Jacobian are compiled: the kernel's own equations, with the same bubble in all lanes (an integrator
that asks for one has nothing else to fill them with), and their forward differences, a column in each lane. The matrix
is dense: a spectral grid couples every node with every other, so there is no band to tell an integrator of.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba as nb
import numpy as np

from en4dvar_bubble import BubbleModel
from en4dvar_bubble.laws.tabulate import GRID
from en4dvar_bubble.paths import pack
from en4dvar_bubble.solver.arrays import Loaded
from en4dvar_bubble.solver.integrate import groups
from en4dvar_bubble.solver.lanes import WIDTH, load, store
from en4dvar_bubble.solver.rows import SMEARED, TABLE
from en4dvar_bubble.solver.step import _rhs
from en4dvar_bubble.tables import from_values

Array = np.ndarray
RELAXATION = 1e-7
"""µs. Where the medium conducts, the wall's temperature has an algebraic equation, which these integrators cannot take;
it relaxes to that so fast instead."""
_STEP = 1.5e-8  # relative, of the differences


@nb.njit
def _rates(t, y, out, wall, eq, par, elastic, scratch):
    """dy/dt to ``out`` (n, WIDTH) at the states ``y`` (n, WIDTH)."""
    w, _ = groups(scratch)
    store(w.t_stage, 0, t)
    for i in range(len(y)):
        store(w.stage, i, load(y, i))
    _rhs(w.stage, w.t_stage, eq, Loaded(par, elastic), w)
    for i in range(len(y)):
        store(out, i, load(w.f, i) * (1 / RELAXATION if i == wall else 1.0))


@nb.njit
def _derivatives(t, y, out, wall, eq, par, elastic, scratch):
    """∂f/∂y to ``out`` (n, n) at the state ``y`` (n,)."""
    n = len(y)
    moved, f = np.empty((n, WIDTH)), np.empty((n, WIDTH))
    for first in range(0, n, WIDTH - 1):  # the last lane stays where it is
        moved[:, :] = y.reshape(n, 1)
        for lane in range(min(WIDTH - 1, n - first)):
            moved[first + lane, lane] += _STEP * max(abs(y[first + lane]), 1e-3)
        _rates(t, moved, f, wall, eq, par, elastic, scratch)
        for lane in range(min(WIDTH - 1, n - first)):
            j = first + lane
            out[:, j] = (f[:, lane] - f[:, WIDTH - 1]) / (moved[j, lane] - y[j])


class Bubble:
    """Member ``i`` of the states ``x`` of a model, its vapour ``smeared``. ``n`` unknowns, ``start`` (n,)."""

    def __init__(self, model: BubbleModel, x: Array, i: int, smeared: float = 0.0) -> None:
        members, memory, viscous, pulse = pack(model, x, 0.0, np.ones((len(x), 1)))
        solver, system = model.solver, model.system
        self.start, self.n = members.initial[i].copy(), system.size
        self._atol = system.tolerances(1.0)[0]
        wall = system.wall_row if system.wall else -1
        par = np.repeat(members.parameters[i][:, None], WIDTH, axis=1)
        cells = max(members.tables.shape[1], GRID.cells)
        scratch = solver._scratch(len(par), cells)
        par[SMEARED] = smeared
        par[TABLE] = np.arange(WIDTH) * scratch.elastic[0].size
        if len(members.samples):
            scratch.elastic[:] = from_values(members.factor * np.repeat(members.samples[i : i + 1], WIDTH, axis=0))
        else:
            scratch.elastic[:] = members.tables[i]
        equations = solver.equations(memory, viscous, pulse, cells > GRID.cells)
        self._rest = wall, equations, par, scratch.elastic, scratch
        self._lanes, self._found = np.empty((self.n, WIDTH)), np.empty((self.n, WIDTH))

    def rates(self, t: float, y: Array, out: Array) -> None:
        self._lanes[:] = y[:, None]
        _rates(t, self._lanes, self._found, *self._rest)
        out[:] = self._found[:, 0]

    def lsoda(self, times: Array, rtol: float) -> Array:
        """R (µm) at ``times`` (µs) by scipy's LSODA (odeint: the whole loop is compiled). Raises RuntimeError."""
        from scipy.integrate import odeint

        f, matrix = np.empty(self.n), np.empty((self.n, self.n))

        def rates(t: float, y: Array) -> Array:
            self.rates(t, y, f)
            return f

        def derivatives(t: float, y: Array) -> Array:
            _derivatives(t, y, matrix, *self._rest)
            return matrix

        grid, options = np.r_[0.0, times], {"rtol": rtol, "atol": rtol * self._atol, "mxstep": 100_000}
        y, told = odeint(rates, self.start, grid, tfirst=True, Dfun=derivatives, full_output=True, **options)
        if told["message"] != "Integration successful.":
            raise RuntimeError(told["message"])
        return np.exp(y[1:, -1])

    def cvode(self, times: Array, rtol: float) -> Array:
        """The same by SUNDIALS CVODE (scikit-sundae), BDF."""
        from sksundae.cvode import CVODE

        def derivatives(t: float, y: Array, f: Array, out: Array) -> None:
            _derivatives(t, y, out, *self._rest)

        options: dict[str, Any] = {"rtol": rtol, "atol": rtol * self._atol, "max_num_steps": 100_000}
        solver = CVODE(self.rates, jacfn=derivatives, linsolver="dense", **options)
        solution = solver.solve(np.r_[0.0, times], self.start)
        if not solution.success:
            raise RuntimeError(solution.message)
        return np.exp(np.asarray(solution.y)[1:, -1])


INTEGRATORS: dict[str, Callable[[Bubble, Array, float], Array]] = {"LSODA": Bubble.lsoda, "CVODE": Bubble.cvode}
