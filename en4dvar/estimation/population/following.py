r"""How parameters that vary between data sets follow the quantities θ ~ N(0, I) which all data sets have in common.

Data tell a coordinate y of each parameter, and x follows from it and from θ. Where what is common shifts the
transformed parameter (a density that multiplies a viscosity), x = y + B(y)θ, B constant or, along a valley that the
data leave open, changing linearly with y. Where it adds to a parameter that is positive, as a pressure adds as many
pascals to every modulus,

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
LARGE, CHANGE = 3.0, 0.3  # of slopes, and of them along a prior standard deviation, in units of the prior
NARROWEST = 1e-12  # variance of y, where what is common decides it alone
STEPS = 16  # along θ, of a B that changes
LEVELS = ndtri((np.arange(200) + 0.5) / 200)  # equally likely values of a normal quantity


@dataclass(frozen=True)
class Following:
    """``slopes`` (p, c): B about ``centre`` (p,), or A in units of the prior median where ``logs`` (p,) holds s, which
    is 0 beside B; ``bends`` (p, c, p): how B changes with y.
    """

    slopes: Array
    logs: Array
    bends: Array | None = None
    centre: Array | float = 0.0

    def own(self, x: Array, theta: Array) -> Array:
        """y (…, p) of x (…, p) and θ (…, c)."""
        return self._shrunk(self._moved(x, -theta @ self.slopes.T), theta)

    def together(self, y: Array, theta: Array) -> Array:
        """x (…, p) of y (…, p) and θ (…, c)."""
        grown = (self._grown(theta) @ (y - self.centre)[..., None])[..., 0]
        return self._moved(self.centre + grown, theta @ self.slopes.T)

    def _shrunk(self, x: Array, theta: Array) -> Array:
        apart = np.linalg.solve(self._grown(theta), (x - self.centre)[..., None])[..., 0]
        return np.asarray(self.centre + apart, dtype=float)

    def at(self, y: Array) -> Array:
        """B (D, p, c) at y (D, p)."""
        slopes = np.broadcast_to(self.slopes, (len(y), *self.slopes.shape))
        return slopes if self.bends is None else slopes + np.einsum("dk,jck->djc", y - self.centre, self.bends)

    def _grown(self, theta: Array) -> Array:
        """(…, p, p): ∂x/∂y, but for what adds; in :data:`STEPS` along θ: one long step folds where B changes much,
        where all y have one x and populations that no data set allows would explain all.
        """
        of_all = np.broadcast_to(np.eye(len(self.slopes)), (*theta.shape[:-1], *[len(self.slopes)] * 2))
        if self.bends is None:
            return of_all
        return np.linalg.matrix_power(of_all + np.einsum("...c,jck->...jk", theta, self.bends / STEPS), STEPS)

    def _moved(self, x: Array, shift: Array) -> Array:
        adds, moved = self.logs > 0, x + shift
        whole = np.exp(self.logs[adds] * x[..., adds])
        moved[..., adds] = np.log(np.maximum(whole + shift[..., adds], LEAST * whole)) / self.logs[adds]
        return np.asarray(moved)

    def moments(self, mean: Array, variance: Array, theta: Array) -> tuple[Array, Array]:
        """Mean (B, p) and precision (B, p, p) of y where x is normal, of three nodes (Gauss and Hermite) where what is
        common adds, else exact.
        """
        shift = -theta @ self.slopes.T
        y = np.stack([self._moved(mean + node * np.sqrt(variance), shift) for node in NODES])
        middle, grown = np.tensordot(NODE_WEIGHTS, y, 1), self._grown(theta)
        precision = 1 / (np.tensordot(NODE_WEIGHTS, (y - middle) ** 2, 1) + NARROWEST)
        return self._shrunk(middle, theta), np.einsum("bji,bj,bjk->bik", grown, precision, grown)

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

    def against(self, x: Array, theta: Array, mean: Array | float, std: Array | float) -> Array:
        """(D,) ln of how many times a normal prior's density at y is that at x of draws x (D, p) and θ (D, c)."""
        y = self.own(x, theta)
        logs = 0.5 * np.sum(((x - mean) / std) ** 2 - ((y - mean) / std) ** 2, axis=1)
        return np.asarray(logs + (x - y) @ self.logs)

    def prior(self, y: Array, mean: Array, std: Array) -> tuple[Array, Array]:
        """Standard deviations (p,) of a normal density about ``mean`` (p,), and ln (D,) of how many times it is the
        prior's of y (D, p): of x ~ N(mean, diag std²), θ ~ N(0, I).
        """
        size = np.sqrt(np.sum(self.slopes**2, axis=1))
        of_y, shifts = np.where(self.logs > 0, std, np.sqrt(std**2 + size**2)), self.logs == 0
        apart, slopes = (y - mean)[:, shifts], self.at(y)[:, shifts]
        covariance = np.diag(std[shifts] ** 2) + slopes @ slopes.swapaxes(1, 2)
        pull = np.linalg.solve(covariance, apart[..., None])[..., 0]
        logs = np.asarray(
            0.5 * np.sum(apart * (pull - apart / of_y[shifts] ** 2), axis=1) - np.sum(np.log(of_y[shifts]))
        )
        logs += 0.5 * np.linalg.slogdet(covariance)[1]
        logs -= np.linalg.slogdet(self._grown(-np.einsum("djc,dj->dc", slopes, pull)))[1]
        for j in np.flatnonzero(self.logs):
            s, whole, shift = self.logs[j], np.exp(self.logs[j] * y[:, j, None]), size[j] * LEVELS
            least = whole < shift * LEAST / (1 - LEAST)  # where as much was left
            before = np.where(least, whole / LEAST, whole + shift)
            possible = before > 0
            x = np.log(np.where(possible, before, 1.0)) / s
            slope = np.where(least, 1.0, whole / np.where(possible, before, 1.0))
            density = np.where(possible, np.exp(-0.5 * ((x - mean[j]) / std[j]) ** 2) * slope, 0.0).mean(axis=1)
            logs += -0.5 * ((y[:, j] - mean[j]) / std[j]) ** 2 - np.log(density + TINY)
        return of_y, logs


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


def bent(following: Following, centre: Array, parts: Sequence[tuple[Array, Array, Array, Array]]) -> Following:
    """With slopes that change along the likelihoods, where what is common does not add.

    ``parts`` of each data set: numbers of draws (M,), centres (M, p), and precisions Λ_xx (M, p, p) and Λ_xθ (M, p, c)
    of the likelihood about them, which has Λ_xθ = −Λ_xx B there. Least squares, by the errors that so many draws leave,
    with slopes of 0 ± :data:`LARGE` and changes of 0 ± :data:`CHANGE` where these say nothing.
    """
    count, at, own, cross = (np.concatenate(each) for each in zip(*parts, strict=True))
    values, vectors = np.linalg.eigh(own)
    values = np.maximum(values, 0.0)
    weight = np.sqrt(count[:, None] / (values + 1))
    p, c = following.slopes.shape
    adds = following.logs > 0
    s = np.where(adds, following.logs, 1.0)
    known = np.where(adds, np.exp(-s * at) / s, 0.0)[..., None] * following.slopes  # B of those that add
    axes = vectors.swapaxes(1, 2)
    target = -weight[..., None] * (axes @ cross + values[..., None] * (axes @ known))
    terms = np.hstack([np.ones((len(at), 1)), at - centre])
    free = np.flatnonzero(~adds)
    design = np.einsum("ml,mlj,mk->mljk", weight * values, axes[..., free], terms).reshape(len(at) * p, -1)
    ridge = np.diag(np.tile(1 / np.append(LARGE, np.full(p, CHANGE)), len(free)))
    rows = np.vstack([design, ridge]), np.vstack([target.reshape(-1, c), np.zeros((len(ridge), c))])
    solved = np.linalg.lstsq(*rows, rcond=None)[0].reshape(len(free), 1 + p, c)
    slopes, bends = following.slopes.copy(), np.zeros((p, c, p))
    slopes[free], bends[free] = solved[:, 0], solved[:, 1:].swapaxes(1, 2)
    return Following(slopes, following.logs, bends, centre)
