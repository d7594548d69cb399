"""Serial ESRF: the deterministic ensemble square-root filter, one observation after the other.

Whitened observations are independent, so that each is a scalar update of what the earlier ones left. With the anomalies
of its prediction v = T s, s the row of S, and D = N − 1 + vᵀv,

    w ← w + Tᵀ v (d − sᵀw) / D,   T ← T − v vᵀT / (D + √((N−1) D)).

No matrix is decomposed. Mean and covariance are those of one analysis with all observations; the members differ from
those of the symmetric root by a rotation.

Source: Whitaker & Hamill (2002), Mon. Wea. Rev. 130, 1913, eqs. 10–13.
"""

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from en4dvar.schemes.base import Draw, Evaluation, GaussNewtonStep, Step, Weights
from en4dvar.schemes.etkf import ETKF


@dataclass(frozen=True)
class ESRF(ETKF):
    """The filter."""

    words: ClassVar[str] = "serial square root"

    def advance(self, weights: Weights, evaluation: Evaluation, iteration: int, draw: Draw) -> Step | GaussNewtonStep:
        w, transform, prior_precision = weights.w.copy(), weights.T.copy(), len(weights.w) - 1.0
        for d, s in zip(evaluation.d, evaluation.S, strict=True):
            v = transform @ s
            total = prior_precision + float(v @ v)
            gain = v @ transform / total
            w += gain * (d - float(s @ w))
            transform -= np.outer(v, gain / (1 + math.sqrt(prior_precision / total)))
        moved, seen = w - weights.w, evaluation.S @ (w - weights.w)
        return Step(Weights(w, transform), math.sqrt(prior_precision * float(moved @ moved) + float(seen @ seen)))
