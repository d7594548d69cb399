r"""EnKF-N: the finite-size ensemble Kalman filter, which finds the inflation that sampling errors call for.

Mean and covariance of the forecast are known only from N members. Integrated over what they may be, the prior is a
Student's t in weight space,

    J(w) = ½ ‖d − Sw‖² + ½ (N+1) ln(ε_N + ‖w‖²),   ε_N = 1 + 1/N,

whose minimum is that of ½ ‖d − Sw‖² + ½ ζ ‖w‖² with the precision ζ that minimises the dual cost

    D(ζ) = ½ dᵀ (I + SSᵀ/ζ)⁻¹ d + ½ ε_N ζ + ½ (N+1) ln((N+1)/ζ) − ½ (N+1),   0 < ζ ≤ (N+1)/ε_N.

The transform is a root of (N−1) H⁻¹ with the Hessian of J at its minimum, H = SᵀS + ζ I − 2 ζ²/(N+1) w wᵀ.

Sources: Bocquet (2011), Nonlin. Processes Geophys. 18, 735; dual: Bocquet & Sakov (2012), Nonlin. Processes Geophys.
19, 383, § 3; Bocquet, Raanes & Hannart (2015), Nonlin. Processes Geophys. 22, 645.
"""

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from en4dvar.ensemble.linalg import Hessian
from en4dvar.model.state import Array
from en4dvar.schemes.base import Draw, Evaluation, GaussNewtonStep, Step, Weights
from en4dvar.schemes.etkf import ETKF


@dataclass(frozen=True)
class EnKFN(ETKF):
    """The filter; it needs no inflation where the model is right."""

    words: ClassVar[str] = "finite size"

    def advance(self, weights: Weights, evaluation: Evaluation, iteration: int, draw: Draw) -> Step | GaussNewtonStep:
        n_members = len(weights.w)
        hessian = Hessian.of(evaluation.S)  # its rows are orthogonal, of lengths σ: SᵀS = rowsᵀ rows
        squares = hessian.singular_values**2
        slope = evaluation.d @ evaluation.S
        # of dᵀd only the part that S can explain, (rows Sᵀd)² / σ⁴ in each direction, depends on ζ
        informed = squares > np.finfo(float).eps * max(1.0, float(squares.max(initial=0.0)))
        projected = np.zeros_like(squares)
        projected[informed] = (hessian.rows[informed] @ slope) ** 2 / squares[informed] ** 2
        zeta = prior_precision(projected, squares, n_members)
        w = hessian.solve(slope, damping=zeta / hessian.prior_precision - 1)
        seen = hessian.rows @ w
        length = float(seen @ seen) + zeta * float(w @ w) - 2 * zeta**2 / (n_members + 1) * float(w @ w) ** 2
        return Step(Weights(w, transform(hessian, zeta, w)), math.sqrt(max(0.0, length)))


def transform(hessian: Hessian, zeta: float, w: Array) -> Array:
    """T = √(N−1) (I + b z zᵀ) G^{-1/2}, a root of (N−1) H⁻¹, with G = SᵀS + ζ I and z = G^{-1/2} w.

    H = G^{1/2} (I − c z zᵀ) G^{1/2}, c = 2 ζ²/(N+1), takes one decomposition. 1ᵀT ∝ 1ᵀ, as z ⟂ 1.
    """
    root = np.sqrt(hessian.singular_values**2 + zeta)
    shrink = 1 / (math.sqrt(zeta) * root * (math.sqrt(zeta) + root))  # (1/√ζ − 1/root) / σ²
    inverse_root = np.eye(len(w)) / math.sqrt(zeta) - (hessian.rows.T * shrink) @ hessian.rows
    z = inverse_root @ w
    square = float(z @ z)
    c = 2 * zeta**2 / (len(w) + 1)
    kept = math.sqrt(max(1 - c * square, np.finfo(float).eps))  # positive at a minimum but for rounding
    stretch = c / (kept * (1 + kept))  # (1/kept − 1) / |z|²
    scaled = inverse_root + np.outer(stretch * z, z @ inverse_root)
    return np.asarray(math.sqrt(hessian.prior_precision) * scaled)


def prior_precision(projected: Array, squares: Array, n_members: int) -> float:
    """The minimiser ζ of the dual cost, a zero of its slope 2 dD/d ln ζ.

    ``projected`` (m,) are the squares of d along the left singular vectors of S, ``squares`` (m,) those of its singular
    values.
    """
    from scipy.optimize import brentq

    epsilon = 1 + 1 / n_members

    def slope(log_zeta: float) -> float:
        zeta = math.exp(log_zeta)
        return float(projected @ (zeta * squares / (zeta + squares) ** 2)) + epsilon * zeta - (n_members + 1)

    largest = math.log((n_members + 1) / epsilon)
    smallest = largest - 12
    if slope(smallest) >= 0:
        return math.exp(smallest)
    return math.exp(float(brentq(slope, smallest, largest + 1e-9, xtol=1e-12)))
