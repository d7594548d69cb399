r"""Symmetric positive definite matrices of arrow form: a border that all blocks share, and blocks of their own.

    [ A    B_1 … B_E ]        S  = A − Σ_e B_e C_e⁻¹ B_eᵀ
    [ B_1ᵀ C_1       ]        x  = S⁻¹ (a − Σ_e B_e C_e⁻¹ b_e)
    [ …          C_E ]        y_e = C_e⁻¹ (b_e − B_eᵀ x)

The cost grows with the number of blocks, not with its square.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular

from en4dvar.model.state import Array
from en4dvar.priors.prior import whiten_sample


@dataclass(frozen=True)
class Arrow:
    """``border`` A (c, c); for each of E experiments ``edges`` B_e (c, n_e) and ``blocks`` C_e (n_e, n_e).

    c and any n_e may be 0.
    """

    border: Array
    edges: Sequence[Array]
    blocks: Sequence[Array]

    @cached_property
    def schur(self) -> Array:
        """S (c, c): the precision of the border with all blocks eliminated."""
        passed = (edge @ self._solve(e, edge.T) for e, edge in enumerate(self.edges))
        return np.asarray(self.border - sum(passed, start=np.zeros_like(self.border)))

    @property
    def log_determinant(self) -> float:
        """ln det of the whole matrix."""
        own = sum(2 * float(np.log(np.diag(factor[0])).sum()) for factor in self._factors)
        return own + float(np.linalg.slogdet(self.schur)[1] if len(self.border) else 0.0)

    def solve(self, a: Array, b: Sequence[Array]) -> tuple[Array, list[Array]]:
        """x (c,) and y_e (n_e,) for the right-hand side a (c,), b_e (n_e,)."""
        passed = (edge @ self._solve(e, b[e]) for e, edge in enumerate(self.edges))
        a = a - sum(passed, start=np.zeros_like(a))
        x = np.asarray(np.linalg.solve(self.schur, a)) if len(a) else a
        return x, [self._solve(e, b[e] - edge.T @ x) for e, edge in enumerate(self.edges)]

    def sample(self, border: Array, own: Callable[[int], Array]) -> tuple[Array, list[Array]]:
        """N draws of the Gaussian of mean zero with this precision: border (N, c), and (N, n_e) of each experiment.

        Parameters
        ----------
        border: (N, c) standard normal numbers; own: gives those (N, n_e) of an experiment by its number.

        Mean and covariance of the N draws of every pair (border, experiment) are exact. Those of different experiments
        are independent given the border, up to what N draws correlate by chance.

        Raises
        ------
        ValueError: N is not larger than c + n_e.
        """
        x = whiten_sample(border)
        if x.shape[1]:
            x = solve_triangular(np.linalg.cholesky(self.schur).T, x.T).T
        return x, [self._own(e, edge, x, border, own(e)) for e, edge in enumerate(self.edges)]

    def _own(self, e: int, edge: Array, x: Array, border: Array, numbers: Array) -> Array:
        """Draws of an experiment's own quantities given those of the border."""
        count, size = len(x), edge.shape[0] + edge.shape[1]
        if count <= size:
            raise ValueError(f"{count} draws are too few for {size} quantities; at least {size + 1}")
        standard = whiten_sample(np.hstack([border, numbers]))[:, edge.shape[0] :]  # orthogonal to the border's
        factor = self._factors[e][0]
        return np.asarray(solve_triangular(factor, standard.T).T - self._solve(e, edge.T @ x.T).T)

    def _solve(self, e: int, right: Array) -> Array:
        return np.asarray(cho_solve(self._factors[e], right)) if len(right) else right

    @cached_property
    def _factors(self) -> list[tuple[Array, bool]]:
        """Upper Cholesky factors of the blocks."""
        return [cho_factor(block) if len(block) else (block, False) for block in self.blocks]
