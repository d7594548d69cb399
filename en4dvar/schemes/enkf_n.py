r"""EnKF-N: the finite-size ensemble Kalman filter, which finds the inflation that sampling errors call for.

Mean and covariance of the forecast are known only from N members. Integrated over what they may be, the prior is a
Student's t in weight space,

    J(w) = ½ ‖d − Sw‖² + ½ c ln(ε_N + ‖w‖²),   ε_N = 1 + 1/N,

whose minimum is that of ½ ‖d − Sw‖² + ½ ζ ‖w‖² with the precision ζ that minimises the dual cost

    D(ζ) = ½ dᵀ (I + SSᵀ/ζ)⁻¹ d + ½ ε_N ζ + ½ c ln(c/ζ) − ½ c,   0 < ζ ≤ c/ε_N.

The transform is a root of (N−1) H⁻¹ with the Hessian of J at its minimum, H = SᵀS + ζ I − 2 (ζ²/c) w wᵀ.

The integral has c = N+1 = ε_N N. Without information ζ then is N, and not N−1, so that every cycle would take a share
of 1/N of the variance. The innovations of an ensemble that is right lower ζ again, by DFS/ε_N on average,
DFS = Σ σ²/(N−1+σ²) of the singular values σ of S. They balance that share where DFS = ε_N; below, c is smaller:

    c = ε_N (N−1) + min(ε_N, DFS).

The mode correction of Bocquet, Raanes & Hannart (2015, eq. 36), as DAPPER has it, moves c/ε_N from N to N−1 by the
share 1 − DFS/N instead: an ensemble that is right then grows by DFS/N of its variance in every cycle.

Sources: Bocquet (2011), Nonlin. Processes Geophys. 18, 735; dual: Bocquet & Sakov (2012), Nonlin. Processes Geophys.
19, 383, § 3; Bocquet, Raanes & Hannart (2015), Nonlin. Processes Geophys. 22, 645.
"""

import math
from dataclasses import dataclass

import numpy as np

from en4dvar.ensemble.linalg import Hessian
from en4dvar.model.state import Array
from en4dvar.schemes.base import Draw, Evaluation, GaussNewtonStep, Step, Weights
from en4dvar.schemes.filters import ETKF


@dataclass(frozen=True)
class EnKFN(ETKF):
    """The filter; it needs no inflation where the model is right."""

    words = "finite size"

    def advance(self, weights: Weights, evaluation: Evaluation, iteration: int, draw: Draw) -> Step | GaussNewtonStep:
        n_members = len(weights.w)
        hessian = Hessian.of(evaluation.S)  # its rows are orthogonal, of lengths σ: SᵀS = rowsᵀ rows
        squares = hessian.singular_values**2
        slope = evaluation.d @ evaluation.S
        # of dᵀd only the part that S can explain, (rows Sᵀd)² / σ⁴ in each direction, depends on ζ
        informed = squares > np.finfo(float).eps * max(1.0, float(squares.max(initial=0.0)))
        projected = np.zeros_like(squares)
        projected[informed] = (hessian.rows[informed] @ slope) ** 2 / squares[informed] ** 2
        epsilon, prior = 1 + 1 / n_members, hessian.prior_precision
        c = epsilon * prior + min(epsilon, float(np.sum(squares / (prior + squares))))
        zeta = prior_precision(projected, squares, epsilon, c)
        w = hessian.solve(slope, damping=zeta / prior - 1)
        seen = hessian.rows @ w
        bend = 2 * zeta**2 / c
        length = float(seen @ seen) + zeta * float(w @ w) - bend * float(w @ w) ** 2
        return Step(Weights(w, transform(hessian, zeta, w, bend)), math.sqrt(max(0.0, length)))


def transform(hessian: Hessian, zeta: float, w: Array, bend: float) -> Array:
    """T = √(N−1) (I + b z zᵀ) G^{-1/2}, a root of (N−1) H⁻¹, with G = SᵀS + ζ I and z = G^{-1/2} w.

    H = G^{1/2} (I − a z zᵀ) G^{1/2}, a = 2 ζ²/c (``bend``), takes one decomposition. 1ᵀT ∝ 1ᵀ, as z ⟂ 1.
    """
    root = np.sqrt(hessian.singular_values**2 + zeta)
    shrink = 1 / (math.sqrt(zeta) * root * (math.sqrt(zeta) + root))  # (1/√ζ − 1/root) / σ²
    inverse_root = np.eye(len(w)) / math.sqrt(zeta) - (hessian.rows.T * shrink) @ hessian.rows
    z = inverse_root @ w
    square = float(z @ z)
    kept = math.sqrt(max(1 - bend * square, np.finfo(float).eps))  # positive at a minimum but for rounding
    stretch = bend / (kept * (1 + kept))  # (1/kept − 1) / |z|²
    scaled = inverse_root + np.outer(stretch * z, z @ inverse_root)
    return np.asarray(math.sqrt(hessian.prior_precision) * scaled)


def prior_precision(projected: Array, squares: Array, epsilon: float, c: float) -> float:
    """The minimiser ζ of the dual cost, a zero of its slope 2 dD/d ln ζ.

    ``projected`` (m,) are the squares of d along the left singular vectors of S, ``squares`` (m,) those of its singular
    values; ``epsilon`` is ε_N.
    """
    from scipy.optimize import brentq

    def slope(log_zeta: float) -> float:
        zeta = math.exp(log_zeta)
        return float(projected @ (zeta * squares / (zeta + squares) ** 2)) + epsilon * zeta - c

    largest = math.log(c / epsilon)
    smallest = largest - 12
    if slope(smallest) >= 0:
        return math.exp(smallest)
    return math.exp(float(brentq(slope, smallest, largest + 1e-9, xtol=1e-12)))
