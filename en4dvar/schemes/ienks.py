"""IEnKS: the iterative ensemble Kalman smoother on a sliding window, lag L, shift 1, single data assimilation.

The window [t_{k−L}, t_k] holds one new observation vector, y_k: each is assimilated once (SDA), earlier ones live in
the ensemble at the start of the window. The weights act there,

    J(w) = ½ ‖y_k − H F_{k←k−L}(x̄ + Xᵀw)‖²_R + (N−1)/2 ‖w‖²,

and are found by Gauss–Newton iterations. L = 1 is the IEnKF, L = 0 the maximum-likelihood ensemble filter; L = 0 with
one iteration is the ETKF. The predictions' anomalies are those of the members, not projected on the anomalies of the
state, as in the papers: Sakov, Oliver & Bertino (2012), Mon. Wea. Rev. 140, 1988; Bocquet & Sakov (2014), Q. J. R.
Meteorol. Soc. 140, 1521.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

import numpy as np
from annotated_types import Ge, Gt, Le

from en4dvar.ensemble.linalg import centre
from en4dvar.schemes.base import Draw, Evaluation, GaussNewtonStep, Runs, Step, Weights, gauss_newton
from en4dvar.state import Array


@dataclass(frozen=True)
class IEnKS:
    """The smoother. Iterations end with the step that is below ``tolerance`` posterior standard deviations, √(δwᵀAδw).

    That step is taken, so what is left is smaller by the square.

    ``transform``: members at the rows of 1wᵀ + T, Y = T⁻¹(P − p̄). ``bundle``: at 1wᵀ + εI, Y = (P − p̄)/ε.
    """

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

    on: ClassVar[tuple[str, ...]] = ("series",)
    passes: ClassVar[int] = 1
    cycled: ClassVar[bool] = True
    searches: ClassVar[bool] = False

    def members(self, weights: Weights, basis: Array | None = None) -> Array:
        """Rows (N, N) of 1wᵀ + T or 1wᵀ + εI."""
        spread = weights.T if self.linearisation == "transform" else self.epsilon * np.eye(len(weights.w))
        return np.asarray(weights.w + spread)

    def linearise(self, weights: Weights, runs: Runs) -> tuple[Array, Array]:
        """Mean prediction p̄ (K',) and anomalies per unit weight Y (N, K')."""
        mean, anomalies = centre(runs.predictions)
        if self.linearisation == "bundle":
            return mean, anomalies / self.epsilon
        if weights.inverse is None:
            return mean, np.asarray(np.linalg.solve(weights.T, anomalies))
        return mean, np.asarray(weights.inverse @ anomalies)

    def advance(self, weights: Weights, evaluation: Evaluation, iteration: int, draw: Draw) -> Step:
        """Weights after a Gauss–Newton step, with the symmetric transform."""
        step = gauss_newton(weights.w, evaluation)
        inverse = step.hessian.inverse_transform if self.linearisation == "transform" else None
        return Step(Weights(step.w + step.direction, step.transform, inverse), step.norm)

    def done(self, iteration: int, step: Step | GaussNewtonStep) -> bool:
        """After the step below the tolerance, or the last one allowed."""
        return step.norm <= self.tolerance or iteration + 1 == self.max_iterations
