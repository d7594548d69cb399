"""Inflation: what sequential schemes add to the spread that sampling error and model error take away.

    multiplicative   X ← λ X                                                    Anderson & Anderson (1999)
    RTPS             X_j ← X_j (1 + α (σ_b,j − σ_a,j) / σ_a,j)                   Whitaker & Hamill (2012)

Both act on the anomalies of the analysis and leave its mean.
"""

from dataclasses import dataclass

import numpy as np

from en4dvar.model.state import Array


@dataclass(frozen=True)
class Inflation:
    """λ ``multiplicative`` and α ``rtps`` (relaxation to prior spread, 0: none, 1: the spread of the prior).

    Raises ValueError: a factor that is not positive, or α outside [0, 1].
    """

    multiplicative: float = 1.0
    rtps: float = 0.0

    def __post_init__(self) -> None:
        if not self.multiplicative > 0:
            raise ValueError(f"multiplicative inflation must be positive, not {self.multiplicative:g}")
        if not 0 <= self.rtps <= 1:
            raise ValueError(f"rtps must lie in [0, 1], not {self.rtps:g}")

    def apply(self, prior: Array, anomalies: Array) -> Array:
        """Analysis anomalies (N, n) inflated; ``prior`` (N, n) is the ensemble before the analysis."""
        if self.rtps:
            spread = np.sqrt(np.sum(anomalies**2, axis=0) / (len(anomalies) - 1))
            anomalies = anomalies * relaxation(prior.std(axis=0, ddof=1), spread, self.rtps)
        return anomalies if self.multiplicative == 1 else self.multiplicative * anomalies


def relaxation(prior_std: Array, posterior_std: Array, alpha: float) -> Array:
    """Factors (n,) of relaxation to prior spread; 1 where the posterior has no spread.

    Source: Whitaker & Hamill (2012), Mon. Wea. Rev. 140, 3078, eq. 2.
    """
    lost = prior_std - posterior_std
    return 1 + alpha * np.divide(lost, posterior_std, out=np.zeros_like(lost), where=posterior_std > 0)
