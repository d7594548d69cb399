"""The posterior beside readings that are bounds: the Gaussian of all else, cut off softly.

About a minimum of J the curvature of a bound is that of a Gaussian on one side and zero on the other, so no Gaussian is
near. With the predictions linear about it, all but the bounds is a Gaussian in closed form; its draws are moved by
elliptical slice sampling (Murray, Adams & MacKay 2010, AISTATS 9, 541), which needs no run of the model.
"""

from collections.abc import Callable

import numpy as np

from en4dvar.data.noise import Linearisation, Predicted, sides_of
from en4dvar.descent.weight_space import WeightSpace
from en4dvar.model.state import Array
from en4dvar.priors.prior import member_stream

SWEEPS = 200


def bounded_members(space: WeightSpace, linear: Linearisation, w: Array, posterior: Array, seed: int) -> Array:
    """Members (N, n), transformed, in place of ``posterior`` (N, n), the Gaussian about the mode, of weights w (N,)."""
    observations, basis = space.problem.observations, space.basis
    bounds = sides_of(observations.noise) != 0
    if not bounds.any():
        return posterior
    d, S = observations.whiten(linear)
    others = np.resize(~bounds, len(d))
    d, S = d[others], S[others]
    n_members, r = len(posterior), basis.shape[1]
    prior = np.sqrt(n_members - 1)
    orthogonal, root = np.linalg.qr(np.vstack([S, prior * np.eye(r)]))
    middle = np.linalg.solve(root, orthogonal.T @ np.concatenate([d, -prior * basis.T @ w]))
    weights = np.where(bounds, observations.weights, 0.0)

    def cost(z: Array) -> Array:
        """J_o (N,) of the bounds alone, at points z (N, r) that are N(0, I) but for the bounds."""
        predicted = linear.prediction.values + (middle + np.linalg.solve(root, z.T).T) @ linear.anomalies
        return observations.noise.cost(observations.values, weights, Predicted(predicted))

    stream = member_stream(seed, "bounds")
    z = np.tile(root @ -middle, (n_members, 1))  # at the mode
    for _ in range(SWEEPS):
        z = _moved(z, cost, stream)
    return space.control(w + (middle + np.linalg.solve(root, z.T).T) @ basis.T)


def _moved(z: Array, cost: Callable[[Array], Array], stream: np.random.Generator) -> Array:
    """A move of each point z (N, r) along an ellipse through it, its arc shrunk until the draw is accepted."""
    other, level = stream.standard_normal(z.shape), cost(z) - np.log(stream.uniform(size=len(z)))
    angle = stream.uniform(0, 2 * np.pi, size=len(z))
    low, high = angle - 2 * np.pi, angle.copy()
    while True:
        moved = z * np.cos(angle)[:, None] + other * np.sin(angle)[:, None]
        refused = cost(moved) > level
        if not refused.any():
            return moved
        low, high = np.where(refused & (angle < 0), angle, low), np.where(refused & (angle >= 0), angle, high)
        angle = np.where(refused, stream.uniform(low, high), angle)
