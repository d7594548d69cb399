"""Localisation of field states: every block of the state is analysed with the observations near it (LETKF).

Observation-error variances are divided by the taper, so that an observation fades out with its distance and is absent
beyond the support. Sources: Hunt, Kostelich & Szunyogh (2007), Physica D 230, 112 (local analysis); Gaspari & Cohn
(1999), Q. J. R. Meteorol. Soc. 125, 723, eq. 4.10 (taper).
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from en4dvar.ensemble.linalg import apply_weights
from en4dvar.model.state import Array, Indices, Mask
from en4dvar.schemes.asked import linearised, step_of
from en4dvar.schemes.base import Draw, Evaluation, Runs, Scheme, Weights
from en4dvar.schemes.filters import ETKF


def gaspari_cohn(distance: Array, radius: float) -> Array:
    """The compactly supported fifth-order correlation: 1 at distance 0, 5/24 at ``radius``, 0 from 2 ``radius`` on.

    >>> gaspari_cohn(np.array([0.0, 1.0, 2.0]), 1.0).round(4).tolist()
    [1.0, 0.2083, 0.0]
    """
    z = np.abs(np.asarray(distance, dtype=float)) / radius
    near = 1 + z * z * (-5 / 3 + z * (5 / 8 + z * (1 / 2 - z / 4)))
    y = np.clip(z, 1, 2)
    far = 4 - 5 * y + y * y * (5 / 3 + y * (5 / 8 + y * (-1 / 2 + y / 12))) - 2 / (3 * y)
    return np.asarray(np.where(z < 1, near, np.maximum(far, 0.0)))


def distances(a: Array, b: Array, period: float | None = None) -> Array:
    """Distances (p, q) between positions (p,) and (q,) on a line, or on a circle of length ``period``."""
    gap = np.abs(a[:, None] - b)
    return gap if period is None else np.minimum(gap % period, -gap % period)


@dataclass(frozen=True)
class BlockLocalisation:
    """``blocks``: indices of the state variables analysed together; ``taper`` (blocks, K') weighs the observations.

    State variables in no block keep their forecast. ``placeless``: the last block is of variables without a place.
    """

    blocks: Sequence[Indices]
    taper: Array
    placeless: bool = False

    @classmethod
    def on_line(
        cls, state: Array, observed: Array, radius: float, period: float | None = None, block_size: int = 1
    ) -> "BlockLocalisation":
        """Blocks of ``block_size`` neighbours of a field at positions ``state`` (n,), NaN for variables not analysed.

        ``observed`` (K',) are the positions of the observations; distances are measured from the middle of a block.
        """
        order = np.argsort(state, kind="stable")[: int(np.sum(np.isfinite(state)))]
        blocks = [order[i : i + block_size] for i in range(0, len(order), block_size)]
        middles = np.array([state[block].mean() for block in blocks])
        return cls(blocks, gaspari_cohn(distances(middles, observed, period), radius))

    @classmethod
    def on_grid(cls, where: Indices, shape: Sequence[int], radius: float, periodic: bool) -> "BlockLocalisation":
        """Every cell by itself of a field on a grid of ``shape``, all cells observed, in C order.

        ``where`` (n,) are the places of the cells in the state; distances are Euclidean, in cells, and around the ends
        of each axis where ``periodic``.
        """
        cells = np.indices(shape, dtype=float).reshape(len(shape), -1)
        lengths = [float(length) if periodic else None for length in shape]
        squares = sum(distances(x, x, length) ** 2 for x, length in zip(cells, lengths, strict=True))
        return cls([where[i : i + 1] for i in range(len(where))], gaspari_cohn(np.sqrt(squares), radius))

    def with_placeless(self, variables: Indices) -> "BlockLocalisation":
        """The same with a block of ``variables`` without a place, for which an observation has its mean weight.

        To first order that is the average of the local analyses. If all observations counted fully, chance correlations
        of few members would make it far too sure.
        """
        taper = np.vstack([self.taper, self.taper.mean(axis=0)])
        return replace(self, blocks=[*self.blocks, variables], taper=taper, placeless=True)

    @property
    def without_place(self) -> Indices:
        """The variables without a place; inflation leaves them alone, for :meth:`rows` keeps their spread."""
        return self.blocks[-1] if self.placeless else np.empty(0, dtype=int)

    def analysed(self, ensemble: Array) -> list[tuple[Indices, Array]]:
        """Blocks and their tapers, of those that vary among the members (N, n) and have observations."""
        varies = np.ptp(ensemble, axis=0) > 0
        pairs = zip(self.blocks, self.taper, strict=True)
        return [(block, taper) for block, taper in pairs if (taper > 0).any() and varies[block].any()]

    def rows(self, block: Indices, weights: Weights) -> Array:
        """Rows (N, N) of the analysis of a block.

        Variables without a place get back what T takes by chance from the variance of anything that no observation
        tells of, on average the share 1 − (‖T‖² − 1)/(N − 1).
        """
        transform, wider = weights.dense, 1.0
        if block is self.without_place:
            wider = max(1.0, math.sqrt((len(transform) - 1) / (np.sum(transform**2) - 1)))
        return np.asarray(weights.w + wider * transform)

    def analysis(self, scheme: Scheme, ensemble: Array, evaluation: Evaluation, draw: Draw) -> Array:
        """Local analysis (N, n) of members (N, n) by a filter's scheme, block by block.

        Variables without a place take the symmetric root in the place of a random T: that :meth:`rows` keep their
        variance on average of many analyses lets it fall in most, and so along a series.
        """
        analysed = ensemble.copy()
        prior = Weights.prior(len(ensemble))
        for block, taper in self.analysed(ensemble):
            own = ETKF() if scheme.perturbs and block is self.without_place else scheme
            step = step_of(own, prior, _tapered(evaluation, taper), 0, _of_some(draw, taper > 0))
            analysed[:, block] = apply_weights(ensemble[:, block], self.rows(block, step.weights))
        return analysed


class BlockDescents:
    """The blocks of a window's ensemble (N, n), each with weights of its own, through the iterations of a smoother.

    The taper is that of the observations' places, also where these are later than the ensemble: what moves far within a
    window asks for a larger radius. Source: Bocquet (2016), Q. J. R. Meteorol. Soc. 142, 1075, § 3.
    """

    def __init__(self, localisation: BlockLocalisation, ensemble: Array):
        self.ensemble = ensemble
        self.near = localisation.analysed(ensemble)
        self.weights = [Weights.prior(len(ensemble))] * len(self.near)

    def members(self, rows: Callable[[Indices, Weights], Array]) -> Array:
        """Members (N, n): ``rows`` (N, N) of each block and its weights, and what is in no block as it was."""
        members = self.ensemble.copy()
        for (block, _), weights in zip(self.near, self.weights, strict=True):
            members[:, block] = apply_weights(self.ensemble[:, block], rows(block, weights))
        return members

    def advance(
        self, scheme: Scheme, runs: Runs, whiten: Callable[[Array, Array], Evaluation], iteration: int, draw: Draw
    ) -> float:
        """A step of every block; the largest, in posterior standard deviations of its block."""
        largest = 0.0
        for i, (_, taper) in enumerate(self.near):
            evaluation = whiten(*linearised(scheme, self.weights[i], runs))
            step = step_of(scheme, self.weights[i], _tapered(evaluation, taper), iteration, _of_some(draw, taper > 0))
            self.weights[i], largest = step.weights, max(largest, step.norm)
        return largest


def _tapered(evaluation: Evaluation, taper: Array) -> Evaluation:
    """The observations that the ``taper`` (K',) leaves."""
    near = taper > 0
    root = np.sqrt(taper[near])
    return Evaluation(root * evaluation.d[near], root[:, None] * evaluation.S[near])


def _of_some(draw: Draw, near: Mask) -> Draw:
    """The numbers of the observations ``near`` (K',): an observation is perturbed in the same way in every block."""
    return lambda purpose, columns=None: draw(purpose, columns) if columns else draw(purpose)[:, near]
