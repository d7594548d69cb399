"""Mixtures fitted to draws: of Gaussians by expectation maximisation, and of Student t to draw proposals from."""

import math
from dataclasses import dataclass

import numpy as np

from en4dvar.model.state import Array

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


def fit_gaussians(
    x: Array, rng: np.random.Generator, components: int, rounds: int, alike: float = 0.0, widest: Array | None = None
) -> tuple[Array, Array, Array]:
    """Shares (M,), means (M, n) and covariances (M, n, n) of a mixture for points (D, n); expectation maximisation.

    Covariances are drawn towards that of all points, of a size that M parts of it have, as if ``alike`` more points of
    each component said so: its mode under the inverse Wishart prior (Fraley & Raftery 2007, J. Classif. 24, 155).
    ``widest`` (n,): standard deviations of independent coordinates; no component exceeds these in any direction.
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
    common = alike * components ** (-2.0 / n) * np.eye(n)
    for _ in range(rounds):
        of_each = np.linalg.cholesky(covariance)  # ln share_m N(z; centre_m, covariance_m) (M, D), (2π)^{−n/2} apart
        white = np.linalg.inv(of_each) @ (z - centre[:, None]).swapaxes(1, 2)
        logs = (np.log(share) - np.log(np.einsum("mii->mi", of_each)).sum(axis=1))[:, None]
        logs = logs - 0.5 * np.sum(white**2, axis=1)
        of_part = np.exp(logs - logs.max(axis=0))
        of_part /= of_part.sum(axis=0)
        size = of_part.sum(axis=1) + 1e-9 * count
        share, centre = size / size.sum(), of_part @ z / size[:, None]
        apart = z - centre[:, None]
        scatter = (of_part[..., None] * apart).swapaxes(1, 2) @ apart + common
        covariance = scatter / (size + alike)[:, None, None] + SMALLEST * np.eye(n)
        if widest is not None:  # the most likely such covariance has the same axes
            unit = root / widest[:, None]
            values, vectors = np.linalg.eigh(unit @ covariance @ unit.T)
            axes = np.linalg.inv(unit) @ vectors
            covariance = axes * np.minimum(values, 1.0)[:, None] @ axes.swapaxes(1, 2)
    return share, middle + centre @ root.T, root @ covariance @ root.T
