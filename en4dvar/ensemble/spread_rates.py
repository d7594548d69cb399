r"""The rate of an observable that R takes from a path which is not straight while an instant is uncertain.

A reading at t + δ with δ ~ N(0, T²) differs from m(t) by a variance of T² ṁ² as long as the path is straight over T.
About the minimum of a collapse it is not: ṁ passes through zero within a hundredth of a frame, so that T |ṁ| says that
a reading there is as good as one at rest, and J has a pit some nanometres wide at every parameter that brings a minimum
to a reading. So the rate is the one that has the variance of the path itself,

    ṁ_T² = Var[m(t + δ)] / T²,

by Gauss–Hermite quadrature with five points, which is exact for polynomials in δ of degree four. T² is the sum of
the squares of the reading's ``time_std`` and of a/v, where a discrepancy of size a (the median of its prior) grows in
proportion to the rate beyond v: such a discrepancy is a model that is early or late by a/v. Before the model begins the
path is taken to stand still.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from en4dvar.model.state import Array
from en4dvar.problem import InverseProblem

NODES, WEIGHTS = np.polynomial.hermite_e.hermegauss(5)
WEIGHTS = WEIGHTS / WEIGHTS.sum()


@dataclass(frozen=True)
class SpreadRates:
    """``time_std`` T (K,) of the readings; increasing ``instants``, of which ``at`` (K,) are those of the readings and
    ``nodes`` (5, K) lie about them.
    """

    time_std: Array
    instants: Array
    at: npt.NDArray[np.intp]
    nodes: npt.NDArray[np.intp]

    def rates(self, values: Array, rates: Array) -> Array:
        """(B, K) from ``values`` (5, B, K) of paths at the nodes; those that are given where T is zero."""
        mean = np.tensordot(WEIGHTS, values, 1)
        variance = np.tensordot(WEIGHTS, (values - mean) ** 2, 1)
        return np.asarray(np.divide(np.sqrt(variance), self.time_std, out=rates.copy(), where=self.time_std > 0))


def spread_rates(problem: InverseProblem) -> SpreadRates | None:
    """None where R needs no rate, or the path is not to be had between the readings, or these are of several series."""
    o = problem.observations
    if not (o.noise.needs_rates and problem.model.dense) or o.parts:
        return None
    time_std = o.noise.time_std
    if np.isfinite(o.noise.grows_beyond):
        name, prior = problem.discrepancy[0].name, problem.prior
        physical = prior.to_physical(prior.mean)
        size = physical[prior.names.index(name)] if name in prior.names else problem.fixed[name]
        time_std = np.hypot(time_std, size / o.noise.grows_beyond)
    beginning = min(0.0, float(o.times[0]))  # a model starts at time zero and need not know what was before
    wanted = np.vstack([o.times, np.maximum(o.times + NODES[:, None] * time_std, beginning)])
    instants, where = np.unique(wanted, return_inverse=True)
    where = where.reshape(wanted.shape)
    return SpreadRates(time_std, instants, where[0], where[1:])
