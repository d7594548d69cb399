"""Tables of functions with kinks or features narrower than the cells of the grid: cells are halved where it takes."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from en4dvar.model.state import Array
from en4dvar_bubble.laws.tabulate import GRID

ERROR = 1e-7
"""Largest error of the stress, relative to the larger of its size there and its largest between λ = 1/2 and 2. Where
cells may still be halved a hundredth of it is asked for, and of the slope 1e-5 of its largest in the cell."""
HALVINGS = 24
"""A kink lies in a cell of 1/32 · 2⁻²⁴ = 2e-9 of ln λ."""
_MOST = 2000  # cells that are halved at once: noise would have all of them halved
_SPREAD = (1 - np.cos(np.linspace(0, np.pi, 6))) / 2
_GAUSS = (np.polynomial.legendre.leggauss(5)[0] + 1) / 2
_CHECKED = np.array([1e-3, 0.04, 0.2, 0.41, 0.5, 0.59, 0.8, 0.96, 0.999])
_POWERS = np.arange(6)


class Refined(NamedTuple):
    """``table`` (cells, 8) of one member, with one cell more than it needs, and ``x``, ln λ of the middle of the cells
    (K,) that hold the function to less than :data:`ERROR`: their coefficients are NaN.
    """

    table: Array
    x: Array


def refine(function: Callable[[Array], Array], slope: bool) -> Refined:
    """A table on :data:`GRID` of a function of ln λ (K,) → (K,), or of that whose ``slope`` it is and which is zero at
    ln λ = 0.

    Each cell is compared with the function at nine points that it was not made from. What lies between them, at first
    1/160 apart, is not seen. Cells in which the function is not finite are not halved.
    """
    points = _GAUSS if slope else _SPREAD
    fit = np.linalg.inv(points[:, None] ** _POWERS[: len(points)])
    asked, to_checked = np.append(points, _CHECKED), (_CHECKED[:, None] ** _POWERS[: len(points)]).T
    left = GRID.origin + GRID.step * np.arange(GRID.cells)
    places, records, inexact = np.arange(GRID.cells), np.zeros((GRID.cells, 8)), []
    central = floor = 0.0
    for level in range(HALVINGS + 1):
        width = GRID.step * 0.5**level
        both = np.reshape(function((left[:, None] + width * asked).ravel()), (len(left), -1))
        values, exact = both[:, : len(points)], both[:, len(points) :]
        made = values @ fit.T
        difference = made @ to_checked - exact
        error, size = np.abs(difference).max(axis=1), np.abs(exact).max(axis=1)
        if level == 0:
            middle = size[np.abs(left) < np.log(2)]
            central = float(np.max(middle, where=np.isfinite(middle), initial=0.0))
            floor = central * (np.log(2) if slope else 1.0)
        scale = np.maximum(floor, size)
        if slope:
            wrong_slope, error = error, error * width
            largest_slope = np.maximum(size, 1e-3 * central)
        else:
            wrong_slope = error / width
            largest_slope = np.maximum(np.ptp(exact, axis=1) / width, 1e-3 * floor)
        with np.errstate(invalid="ignore"):
            halved = (error > 0.01 * ERROR * scale) | (wrong_slope > 1e-5 * largest_slope) & (error > 1e-13 * scale)
            bad = error > ERROR * scale
        records[places, :6] = np.pad(made, ((0, 0), (int(slope), 0))) if slope else made
        if slope:
            records[places, 1:6] = made * width / np.arange(1, 6)
        records[places, 6] = 2.0**level
        if level == HALVINGS or halved.sum() > _MOST:
            records[places[bad], :6] = np.nan
            inexact = left[bad] + width / 2
            break
        if not halved.any():
            break
        children = len(records) + 2 * np.arange(halved.sum())
        records[places[halved], 7] = children
        records = np.concatenate([records, np.zeros((2 * len(children), 8))])
        places = np.stack([children, children + 1], axis=1).ravel()
        left = (left[halved][:, None] + [0.0, width / 2]).ravel()
    if slope:
        _add_up(records)
    return Refined(np.concatenate([records, np.zeros((1, 8))]), np.asarray(inexact, dtype=float))


def _add_up(records: Array) -> None:
    """Give each cell of an antiderivative its value on the left: in the order of ln λ, from zero at ln λ = 0."""
    leaves: list[int] = []
    unstretched = 0
    for cell in range(GRID.cells):
        if cell == round(-GRID.origin / GRID.step):
            unstretched = len(leaves)
        waiting = [cell]
        while waiting:
            at = waiting.pop()
            half = int(records[at, 7])
            if half:
                waiting += [half + 1, half]
            else:
                leaves.append(at)
    rise = records[leaves, 1:6].sum(axis=1)
    records[leaves[unstretched:], 0] = np.cumsum(rise[unstretched:]) - rise[unstretched:]
    records[leaves[:unstretched], 0] = -np.cumsum(rise[:unstretched][::-1])[::-1]
