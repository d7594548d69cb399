"""One experiment of a joint problem: J_o of control vectors, and its linearisation by runs close to one of them."""

from dataclasses import dataclass

import numpy as np

from en4dvar.data.noise import Linearisation
from en4dvar.ensemble.forecast import NO_TIMES, Composite, Forecast
from en4dvar.ensemble.linalg import bundle_steps
from en4dvar.ensemble.missing import Beside
from en4dvar.estimation.joint.problem import JointProblem
from en4dvar.executor import Executor
from en4dvar.model.state import Array


@dataclass(frozen=True)
class Linearised:
    """J_o at a point, its gradient (n,) and Gauss–Newton Hessian (n, n) in units of the prior, and the central run."""

    cost: float
    gradient: Array
    hessian: Array
    central: Forecast


class Experiment:
    """The runs of experiment ``e``."""

    def __init__(self, joint: JointProblem, e: int, epsilon: float, executor: Executor):
        self.joint, self.e, self.epsilon = joint, e, epsilon
        self.problem = joint.experiments[e]
        self.composite = Beside(Composite(self.problem, executor), self.problem.prior, epsilon)

    def run(self, z: Array, grid: Array = NO_TIMES) -> Forecast:
        """Control vectors (B, n) in units of the prior."""
        return self.composite(self.problem.prior.from_white(z), grid)

    def costs(self, z: Array) -> Array:
        """J_o (B,) of control vectors (B, n) in units of the prior; +inf where the model fails."""
        return self.problem.observations.cost(self.run(z).predicted)

    def linearise(self, z: Array, wider: float = 1.0, hessian: Array | None = None) -> Linearised | None:
        """At z (n,), by n runs beside it; None where it or too many of them fail.

        A run that fails is replaced by the one on the other side. A bundle that is ``wider`` has runs on both sides.
        The ``hessian`` (n, n) of J_o at the place before tells its steps (:func:`bundle_steps`).
        """
        size, steps = self.epsilon * wider, np.eye(len(z))
        if hessian is not None:
            precision, axes = np.linalg.eigh(steps + hessian)
            steps = bundle_steps(1 / np.sqrt(precision), axes, self.epsilon)
        observations, step = self.problem.observations, size * steps
        run = self.run(np.vstack([z, z + step]))
        stacked = run.predicted.stacked
        change = (stacked[1:] - stacked[0]) / size
        again = ~np.isfinite(change).all(axis=1) | (wider > 1)
        if again.any():
            behind = (stacked[0] - self.run(z - step[again]).predicted.stacked) / size
            ahead = change[again]
            both = 0.5 * (ahead + behind)
            change[again] = np.where(np.isfinite(both), both, np.where(np.isfinite(ahead), ahead, behind))
        cost = float(observations.cost(run.predicted)[0])
        if not (np.isfinite(cost) and np.isfinite(change).all()):
            return None
        tangent = np.linalg.solve(steps, change)
        d, S = observations.whiten(Linearisation.of_stacked(run.predicted[0], stacked[0], tangent))
        return Linearised(cost, -S.T @ d, S.T @ S, run[:1])

    def linearise_own(self, z: Array, columns: list[int]) -> tuple[Array, Array, Array]:
        """J_o (M,), its gradient (M, k) and Gauss–Newton Hessian (M, k, k) in k ``columns`` alone, at places (M, n).

        They are NaN where a run fails.
        """
        size, k, observations = self.epsilon, len(columns), self.problem.observations
        beside = z[:, None] + size * np.vstack([np.zeros(z.shape[1]), np.eye(z.shape[1])[columns]])
        run = self.run(beside.reshape(-1, z.shape[1]))
        stacked = run.predicted.stacked.reshape(len(z), k + 1, -1)
        gradient, hessian = np.full((len(z), k), np.nan), np.full((len(z), k, k), np.nan)
        for i in np.flatnonzero(np.isfinite(stacked).all(axis=(1, 2))).tolist():
            change = (stacked[i, 1:] - stacked[i, 0]) / size
            d, S = observations.whiten(Linearisation.of_stacked(run.predicted[i * (k + 1)], stacked[i, 0], change))
            gradient[i], hessian[i] = -S.T @ d, S.T @ S
        return observations.cost(run.predicted)[:: k + 1], gradient, hessian

    def settled(self, border: Array, start: Array, precision: Array, steps: int) -> tuple[Array, Array, Array]:
        """The own quantities that J is low at, given what is shared (M, c): Gauss–Newton from ``start`` (M, n_e).

        Where J has not fallen the step is halved. Returns the lowest places (M, n_e), their precision (M, n_e, n_e), or
        the one given where no run lives, and J_o + J_b of the own quantities (M,) there, +inf where no run lives.
        """
        columns = self.joint.columns(self.e)[1]
        lowest, mean, there, step = np.full(len(start), np.inf), start, start, np.zeros_like(start)
        for _ in range(steps):
            cost, gradient, hessian = self.linearise_own(self.joint.standard(self.e, border, there), columns)
            cost = cost + 0.5 * np.sum(there**2, axis=1)
            lower = (cost < lowest) & np.isfinite(gradient).all(axis=1)
            lowest, mean = np.where(lower, cost, lowest), np.where(lower[:, None], there, mean)
            precision = np.where(lower[:, None, None], np.eye(len(columns)) + hessian, precision)
            newton = np.linalg.solve(precision, (mean + gradient)[..., None])[..., 0]
            step = np.where(lower[:, None], newton, 0.5 * step)
            there = mean - step
        return mean, precision, lowest
