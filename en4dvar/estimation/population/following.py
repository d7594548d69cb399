r"""How parameters that vary between data sets follow the quantities θ ~ N(0, I) which all data sets have in common.

Data tell a coordinate y of each parameter, and x follows from it and from θ. Where what is common shifts the
transformed parameter (a density that multiplies a viscosity), y = x − Bθ. Where it adds to a parameter that is
positive, as a pressure adds as many pascals to every modulus,

    e^{sy} = e^{sx} − Aθ,

with s the prior standard deviation of the logarithm: a slope in ln G would be steeper for a softer gel, and bend.
Which of the two holds is told by the draws: the one under which they are denser, with the same slopes in all data sets.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri

from en4dvar.model.state import Array

LEAST = 0.01  # of a positive parameter is left where what is common would take away more
NODES, NODE_WEIGHTS = np.array([-math.sqrt(3.0), 0.0, math.sqrt(3.0)]), np.array([1.0, 4.0, 1.0]) / 6
TINY = np.finfo(float).tiny
NARROWEST = 1e-12  # variance of y, where what is common decides it alone
LEVELS = ndtri((np.arange(200) + 0.5) / 200)  # equally likely values of a normal quantity


@dataclass(frozen=True)
class Following:
    """``slopes`` (p, c): B, or A in units of the prior median where ``logs`` (p,) holds s, which is 0 beside B."""

    slopes: Array
    logs: Array

    def own(self, x: Array, theta: Array) -> Array:
        """y (…, p) of x (…, p) and θ (…, c)."""
        return self._moved(x, -theta @ self.slopes.T)

    def together(self, y: Array, theta: Array) -> Array:
        """x (…, p) of y (…, p) and θ (…, c)."""
        return self._moved(y, theta @ self.slopes.T)

    def _moved(self, x: Array, shift: Array) -> Array:
        adds, moved = self.logs > 0, x + shift
        whole = np.exp(self.logs[adds] * x[..., adds])
        moved[..., adds] = np.log(np.maximum(whole + shift[..., adds], LEAST * whole)) / self.logs[adds]
        return np.asarray(moved)

    def moments(self, mean: Array, variance: Array, theta: Array) -> tuple[Array, Array]:
        """Mean and variance (B, p) of y where x is normal, of three nodes (Gauss and Hermite): exact for y = x − Bθ."""
        y = np.stack([self.own(mean + node * np.sqrt(variance), theta) for node in NODES])
        centre = np.tensordot(NODE_WEIGHTS, y, 1)
        return centre, np.tensordot(NODE_WEIGHTS, (y - centre) ** 2, 1) + NARROWEST

    def around(self, x: float, own: float, common: float) -> Array:
        """(3,): a coordinate x, where there is one, less and more by ``own`` and, independently, by so many standard
        deviations of what is common.
        """
        sides, size, s = np.array([-1.0, 0.0, 1.0]), common * float(np.linalg.norm(self.slopes)), float(self.logs[0])
        if not s:
            return x + sides * math.hypot(own, size)
        whole = np.exp(s * (x + sides * own))
        moved = whole[1] + sides * np.hypot(whole - whole[1], size)
        return np.asarray(np.log(np.maximum(moved, LEAST * whole)) / s)

    def prior(self, y: Array, mean: Array, std: Array) -> tuple[Array, Array]:
        """Standard deviations (p,) of a normal density about ``mean`` (p,), and ln (D,) of how many times it is the
        prior's of y (D, p): of x ~ N(mean, diag std²), θ ~ N(0, I).
        """
        size = np.sqrt(np.sum(self.slopes**2, axis=1))
        logs = np.zeros(len(y))
        for j in np.flatnonzero(self.logs):
            s, whole, shift = self.logs[j], np.exp(self.logs[j] * y[:, j, None]), size[j] * LEVELS
            least = whole < shift * LEAST / (1 - LEAST)  # where as much was left
            before = np.where(least, whole / LEAST, whole + shift)
            possible = before > 0
            x = np.log(np.where(possible, before, 1.0)) / s
            slope = np.where(least, 1.0, whole / np.where(possible, before, 1.0))
            density = np.where(possible, np.exp(-0.5 * ((x - mean[j]) / std[j]) ** 2) * slope, 0.0).mean(axis=1)
            logs += -0.5 * ((y[:, j] - mean[j]) / std[j]) ** 2 - np.log(density + TINY)
        return np.where(self.logs > 0, std, np.sqrt(std**2 + size**2)), logs


def following_of(
    x: Sequence[Array], theta: Sequence[Array], logs: Array, slopes: Callable[[Sequence[Array]], Array]
) -> Following:
    """Of draws x (D, p) and θ (D, c) of each data set; ``logs`` (p,): s of positive parameters, 0 of others.

    ``slopes`` gives those (p, c) with θ of coordinates (D, p) of each data set, x or e^{sx}.
    """
    positive = logs > 0
    whole = [np.where(positive, np.exp(logs * each), each) for each in x]
    shifting, adding = slopes(x), slopes(whole)
    widths = [
        np.mean([np.log(np.std(u - t @ b.T, axis=0) + TINY) for u, t in zip(of, theta, strict=True)], axis=0)
        for of, b in ((x, shifting), (whole, adding))
    ]
    stretched = np.mean([np.mean(logs * each, axis=0) for each in x], axis=0) + np.log(np.where(positive, logs, 1.0))
    adds = positive & (widths[1] - stretched < widths[0])
    return Following(np.where(adds[:, None], adding, shifting), np.where(adds, logs, 0.0))
