"""The linear algebra of the general equations against numpy's, on random matrices with zeros where theirs are."""

from __future__ import annotations

import numba as nb
import numpy as np
import pytest

from en4dvar_bubble.solver.driver import System
from en4dvar_bubble.solver.general import pattern, places, sums, tiles
from en4dvar_bubble.solver.lanes import WIDTH
from en4dvar_bubble.solver.rodas5p import GAMMA
from en4dvar_bubble.solver.tiles import AREA, EDGE, factorise, place, solve

SYSTEMS = [
    System(3, 3, 2),
    System(3, 3, 2, True),
    System(5, 0, 4, memory=2),
    System(4),
    System(0, memory=2),
    System(7, 7),
    System(7, 7, kinetic=True),
]


@nb.njit
def solved(a, h, where, places, algebraic, x, b, row):
    factorise(a, h, where, places, algebraic)
    solve(a, where, places, x, b, row)


@pytest.mark.slow  # for what it compiles
@pytest.mark.parametrize("system", SYSTEMS)
def test_solution_is_that_of_the_full_matrix(system):
    """Of 1/(hγ) − J, extended by the sums, which have no rate and nothing on their right-hand side."""
    dims, rng = system.dims, np.random.default_rng(0)
    full, kept = pattern(dims), sums.py_func(dims)
    size, fields = len(full), dims.gas + dims.vapour + dims.medium
    minus_J = np.where(full[:, :, None], 0.3 * rng.standard_normal((size, size, WIDTH)), 0.0)
    a_sum = np.zeros(size, dtype=bool)
    a_sum[fields : fields + kept] = True
    h = np.linspace(0.1, 0.5, WIDTH)[None]
    diagonal = np.where(a_sum[:, None], 1.0, 1 / (GAMMA * h))
    for row in range(fields + kept, fields + kept + dims.wall + dims.kinetic):
        diagonal[row] = 0.0
        minus_J[row, row] = 3.0
    matrix = minus_J + diagonal[:, None, :] * np.eye(size)[:, :, None]
    right = rng.standard_normal((size - kept, WIDTH))
    extended = np.zeros((size, WIDTH))
    extended[~a_sum] = right
    expected = np.linalg.solve(matrix.transpose(2, 0, 1), extended.T[:, :, None])[:, ~a_sum, 0].T

    where, of_unknowns = tiles(dims)
    kept_numbers = np.zeros(((where.max() + 1) * AREA, WIDTH))
    for i, j in np.argwhere(full):
        kept_numbers[place.py_func(where, *places(dims)[[i, j]])] = minus_J[i, j]
    before, scratch = np.ones((2, WIDTH)), np.full((len(where) * EDGE, WIDTH), np.nan)
    stages = np.vstack([before, right])
    algebraic = fields, fields + dims.wall + dims.kinetic
    solved(kept_numbers, h, where, of_unknowns, algebraic, scratch, stages, len(before))
    np.testing.assert_array_equal(stages[:2], before)
    np.testing.assert_allclose(stages[2:], expected, rtol=0, atol=1e-12 * np.abs(expected).max())
