"""Mixtures fitted to draws: of Gaussians by expectation maximisation, and of Student t to draw proposals from."""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from en4dvar.model.state import Array
from en4dvar.plumbing.compiled import kernel

DEGREES = 5.0  # of freedom of a proposal: heavier tails than any part of the density has
SMALLEST = 1e-4  # variance that a component keeps in every direction, relative to that of all points


@dataclass(frozen=True)
class StudentMixture:
    """Σ_m share_m t(x; centre_m, root_m root_mᵀ) with :data:`DEGREES` of freedom, in d dimensions."""

    share: Array
    centre: Array
    root: Array

    @classmethod
    def fitted(cls, draws: Array, stream: np.random.Generator, components: int, alike: float = 0.0) -> "StudentMixture":
        """To draws (D, d); ``alike`` as of :func:`fit_gaussians`."""
        share, centre, covariance = fit_gaussians(draws, stream, components, rounds=40, alike=alike)
        return cls(share, centre, np.asarray(np.linalg.cholesky(covariance), dtype=float))

    def draw(self, count: int, stream: np.random.Generator) -> Array:
        """(count, d)."""
        part = np.searchsorted(np.cumsum(self.share), stream.uniform(size=count)).clip(max=len(self.share) - 1)
        normal = stream.standard_normal((count, self.centre.shape[1]))
        scale = np.sqrt(DEGREES / stream.chisquare(DEGREES, count))
        return np.asarray(self.centre[part] + np.einsum("bij,bj->bi", self.root[part], normal * scale[:, None]))

    def log_density(self, x: Array) -> Array:
        """(B,) at points (B, d)."""
        d = x.shape[1]
        z = np.linalg.inv(self.root) @ (x - self.centre[:, None]).transpose(0, 2, 1)
        logs = -0.5 * (DEGREES + d) * np.log1p(np.sum(z**2, axis=1) / DEGREES)
        logs += (np.log(self.share) - np.log(np.einsum("mii->mi", self.root)).sum(axis=1))[:, None]
        constant = math.lgamma((DEGREES + d) / 2) - math.lgamma(DEGREES / 2) - d / 2 * math.log(DEGREES * math.pi)
        return np.asarray(np.logaddexp.reduce(logs, axis=0) + constant)


def resampled(shares: Array, count: int, stream: np.random.Generator) -> npt.NDArray[np.intp]:
    """(count,) indices, each as often as its share says (systematic resampling); shares add up to one."""
    quantiles = (np.arange(count) + stream.uniform()) / count
    return np.searchsorted(np.cumsum(shares), quantiles, side="right").clip(max=len(shares) - 1)


def effective_number(weights: Array) -> float:
    """Number of equally likely draws that are worth as much as draws of these weights, (Σ w)²/Σ w²."""
    return float(weights.sum() ** 2 / np.sum(weights**2))


def fit_gaussians(
    x: Array, rng: np.random.Generator, components: int, rounds: int, alike: float = 0.0
) -> tuple[Array, Array, Array]:
    """Shares (M,), means (M, n) and covariances (M, n, n) of a mixture for points (D, n); expectation maximisation.

    Covariances are drawn towards that of all points, of a size that M parts of it have, as if ``alike`` more points of
    each component said so: its mode under the inverse Wishart prior (Fraley & Raftery 2007, J. Classif. 24, 155).
    """
    count, n = x.shape
    middle, root = x.mean(axis=0), np.linalg.cholesky(np.atleast_2d(np.cov(x, rowvar=False)))
    z = np.linalg.solve(root, (x - middle).T).T
    centre = z[[int(rng.integers(count))]]
    for _ in range(components - 1):  # k-means++ (Arthur & Vassilvitskii 2007)
        distance = np.min(np.sum((z[:, None] - centre) ** 2, axis=2), axis=1)
        centre = np.vstack([centre, z[rng.choice(count, p=distance / distance.sum())]])
    covariance = np.tile(0.3 * np.eye(n), (components, 1, 1))
    share = np.full(components, 1 / components)
    of_part = np.empty((count, components))
    for _ in range(rounds):
        _expect(z, share, centre, covariance, of_part)
        _maximise(z, of_part, share, centre, covariance, alike)
    return share, middle + centre @ root.T, root @ covariance @ root.T


@kernel
def _expect(z: Array, share: Array, centre: Array, covariance: Array, of_part: Array) -> None:
    """Probability ``of_part`` (D, M) of the components for points (D, n)."""
    count, parts = of_part.shape
    apart = np.empty(z.shape[1])
    for m in range(parts):
        lower = np.linalg.cholesky(covariance[m])
        constant = np.log(share[m])
        for i in range(apart.size):
            constant -= np.log(lower[i, i])
        for d in range(count):
            log = constant
            for i in range(apart.size):
                scaled = z[d, i] - centre[m, i]
                for k in range(i):
                    scaled -= lower[i, k] * apart[k]
                apart[i] = scaled / lower[i, i]
                log -= 0.5 * apart[i] ** 2
            of_part[d, m] = log
    for d in range(count):
        top, total = of_part[d].max(), 0.0
        for m in range(parts):
            of_part[d, m] = np.exp(of_part[d, m] - top)
            total += of_part[d, m]
        for m in range(parts):
            of_part[d, m] /= total


@kernel
def _maximise(z: Array, of_part: Array, share: Array, centre: Array, covariance: Array, alike: float) -> None:
    """Share, centre and covariance of the components are overwritten with what their points say."""
    count, parts = of_part.shape
    apart = np.empty(z.shape[1])
    common = alike * parts ** (-2.0 / apart.size)
    for m in range(parts):
        size = 1e-9 * count
        centre[m] = 0.0
        for d in range(count):
            size += of_part[d, m]
            for i in range(apart.size):
                centre[m, i] += of_part[d, m] * z[d, i]
        share[m] = size
        centre[m] /= size
        covariance[m] = 0.0
        for d in range(count):
            for i in range(apart.size):
                apart[i] = z[d, i] - centre[m, i]
                for k in range(i + 1):
                    covariance[m, i, k] += of_part[d, m] * apart[i] * apart[k]
        for i in range(apart.size):
            for k in range(i + 1):
                if i == k:
                    covariance[m, i, k] += common
                covariance[m, i, k] = covariance[m, i, k] / (size + alike) + (SMALLEST if i == k else 0.0)
                covariance[m, k, i] = covariance[m, i, k]
    share /= share.sum()
