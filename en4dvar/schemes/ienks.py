"""IEnKS: the iterative ensemble Kalman smoother on a sliding window, lag L, shift S.

The window [t_{k−L}, t_k] holds S new observation vectors; with S = 1 it is y_k. Each is assimilated once (SDA), earlier
ones live in the ensemble at the start of the window. The weights act there,

    J(w) = ½ ‖y_k − H F_{k←k−L}(x̄ + Xᵀw)‖²_R + (N−1)/2 ‖w‖²,

and are found by Gauss–Newton iterations. L = 1 is the IEnKF, L = 0 the maximum-likelihood ensemble filter; L = 0 with
one iteration is the ETKF. The predictions' anomalies are those of the members, not projected on the anomalies of the
state, as in the papers: Sakov, Oliver & Bertino (2012), Mon. Wea. Rev. 140, 1988; Bocquet & Sakov (2014), Q. J. R.
Meteorol. Soc. 140, 1521.

With multiple data assimilation (MDA) all of y_{k−L+1} … y_k count in each window, with weights β_0 (the newest) to
β_{L−1} that sum to one over the windows that an observation is in: short steps towards each, so that a long window of a
strongly nonlinear F keeps to one minimum. In the linear case it is the same smoother. Bocquet & Sakov (2014), § 4, and
(2013), Nonlin. Processes Geophys. 20, 803.
"""

import math
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from annotated_types import Ge, Gt, Le

from en4dvar.ensemble.linalg import centre
from en4dvar.model.state import Array
from en4dvar.schemes.base import GaussNewtonStep, Runs, Scheme, Step, Weights


@dataclass(frozen=True)
class IEnKS(Scheme):
    """The smoother. Iterations end with the step that is below ``tolerance`` posterior standard deviations, √(δwᵀAδw).

    That step is taken, so what is left is smaller by the square.

    ``transform``: members at the rows of 1wᵀ + T, Y = T⁻¹(P − p̄). ``bundle``: at 1wᵀ + εI, Y = (P − p̄)/ε.
    """

    words = "sliding-window smoother"

    lag: Annotated[int, Ge(0), "Length of the smoother's window in cycles; 0 is a filter."] = 1
    linearisation: Annotated[
        Literal["transform", "bundle"],
        "Regression over the ensemble (transform), or tangent from runs close to the iterate (bundle).",
    ] = "transform"
    epsilon: Annotated[float, Gt(0), Le(1), "Size of the bundle: factor on the anomalies."] = 1e-4
    max_iterations: Annotated[int, Ge(1), "Iteration limit in each cycle."] = 10
    tolerance: Annotated[
        float, Gt(0), "Iterations end where the step is shorter than this, in posterior standard deviations."
    ] = 0.05
    shift: Annotated[int, Ge(1), "Cycles that the window moves on at once, no more than lag."] = 1
    mda_weights: Annotated[
        tuple[Annotated[float, Gt(0)], ...],
        "Multiple data assimilation: how much an observation counts when it is new, one window later, and so on, lag "
        "numbers relative to each other; by default it counts once.",
    ] = (1.0,)

    on = ("series",)

    def __post_init__(self) -> None:
        if self.shift > max(1, self.lag):
            raise ValueError(f"the window moves on by {self.shift} cycles, but is only {self.lag} long")
        count = len(self.mda_weights)
        if count == 0 or (count > 1 and (count != self.lag or self.shift > 1)):
            raise ValueError(f"mda_weights are {self.lag}, one a cycle of the window, and the shift is 1 with them")
        if not all(weight > 0 for weight in self.mda_weights):
            raise ValueError(f"mda_weights must be positive, not {self.mda_weights}")
        object.__setattr__(self, "mda_weights", tuple(w / math.fsum(self.mda_weights) for w in self.mda_weights))

    def members(self, weights: Weights, basis: Array | None = None) -> Array:
        """Rows (N, N) of 1wᵀ + T or 1wᵀ + εI."""
        bundle = self.linearisation == "bundle"
        return np.asarray(weights.w + self.epsilon * np.eye(len(weights.w))) if bundle else weights.rows

    def linearise(self, weights: Weights, runs: Runs) -> tuple[Array, Array]:
        mean, anomalies = centre(runs.predictions)
        if self.linearisation == "bundle":
            return mean, anomalies / self.epsilon
        return mean, np.asarray(np.linalg.solve(weights.T, anomalies))

    def done(self, iteration: int, step: Step | GaussNewtonStep) -> bool:
        return step.norm <= self.tolerance or iteration + 1 == self.max_iterations

    def left(self, step: Step | GaussNewtonStep) -> float:
        """A limit of one iteration is asked for as such: it makes filters and smoothers without iterations."""
        return step.norm if step.norm > self.tolerance and self.max_iterations > 1 else 0.0
