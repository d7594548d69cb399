r"""Kalman gains without the spurious correlations of a small ensemble, for fields and for many parameters.

With anomalies X (N, n) of what is estimated, Y (N, K) of the predictions and independent errors of variance R (K,):

- by **distance**, for what has a place: the covariances are multiplied by a correlation of compact support,

      K = (ρ_xy ∘ XᵀY) [(ρ_yy ∘ YᵀY) + (N−1) R]⁻¹,

  which is (ρ∘P)Hᵀ[H(ρ∘P)Hᵀ + R]⁻¹ exactly where H reads cells of the field, and the usual approximation where it does
  not. One K × K system serves all cells, so that a field of a million costs a product a cell: a local analysis would
  solve a system a cell, and its taper of R⁻¹ is no Schur product with a covariance. Houtekamer & Mitchell (2001), Mon.
  Wea. Rev. 129, 123, eq. 6.
- by **correlation**, for parameters without a place: a parameter is analysed with those observations alone that the
  ensemble correlates it with by more than chance, 3/√N, and their own C_yy. Vossepoel, Evensen & van Leeuwen (2025),
  Mon. Wea. Rev., doi 10.1175/MWR-D-24-0269.1, eq. 6.

Gains are applied to parts of the field, so that memory beside the ensemble is of the size of a part.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from en4dvar.model.state import Array, Indices
from en4dvar.schemes.localisation import gaspari_cohn

PART = 1 << 18  # cells times observations that are worked on at once
FEW = 8  # readings that act on a cell, up to which each has a system of its own, beyond it each set of readings
CHANCE = 3.0  # correlations below this over √N are taken for chance

Update = Callable[[slice, Array], Array]  # (part of the cells, their anomalies (N, m)) → increments (M, m)


@dataclass(frozen=True)
class Split:
    """Anomalies (N, K) of predictions along those of what has a place, and of what has none, where there is any.

    ``related``: what has a place is correlated with what has none, along which ``placed`` has no part.
    """

    placed: Array
    common: Array | None = None
    related: bool = False

    @classmethod
    def by_regression(cls, anomalies: Array, common: Array) -> "Split":
        """Of ``anomalies`` of the predictions, what members (N, q) of what has no place explain, and the rest."""
        X = common - common.mean(axis=0)
        explained = X @ np.linalg.lstsq(X, anomalies)[0]
        return cls(anomalies - explained, explained, related=True)

    @property
    def whole(self) -> Array:
        return self.placed if self.common is None else self.placed + self.common


@dataclass(frozen=True)
class ByDistance:
    """``places`` (n, D) of the cells and ``observed`` (K, D) of the observations; the taper is Gaspari & Cohn's.

    It falls to 5/24 at ``radius`` and to 0 at twice that. All observations act on what has no place (NaN), and nothing
    is tapered of what that explains of the predictions.
    """

    places: Array
    observed: Array
    radius: float

    def __post_init__(self) -> None:
        if self.places.ndim != 2 or self.places.shape[1:] != self.observed.shape[1:] or not self.radius > 0:
            raise ValueError(
                f"places {self.places.shape} and observed {self.observed.shape} must be (n, D) and (K, D), the radius "
                f"{self.radius:g} positive"
            )

    def taper(self, part: slice) -> Array:
        """ρ_xy (m, K) of some of the cells."""
        from scipy.spatial.distance import cdist  # not needed to import the package

        rho = gaspari_cohn(cdist(self.places[part], self.observed), self.radius)
        return np.nan_to_num(rho, copy=False, nan=1.0)

    @property
    def common(self) -> Indices:
        """Which of the cells have no place."""
        return np.flatnonzero(np.isnan(self.places[:, 0]))

    def between(self, Y: Split, Z: Split) -> Array:
        """ρ_yy ∘ YᵀZ/(N−1) (K, K), of anomalies of predictions about two points."""
        from scipy.spatial.distance import cdist  # not needed to import the package

        rho = gaspari_cohn(cdist(self.observed, self.observed), self.radius)
        covariance = rho * (Y.placed.T @ Z.placed) / (len(Y.placed) - 1)
        if Y.common is not None and Z.common is not None:
            covariance += Y.common.T @ Z.common / (len(Y.common) - 1)
        return np.asarray(covariance)

    def along(self, part: slice, anomalies: Array, Y: Split, dual: Array) -> Array:
        """(ρ_xy ∘ XᵀY/(N−1)) λ as rows (M, m), for λ (M, K)."""
        cross = self.taper(part) * (anomalies.T @ Y.placed) / (len(anomalies) - 1)
        if Y.common is not None:
            of_common = anomalies.T @ Y.common / (len(anomalies) - 1)
            nowhere = np.isnan(self.places[part])[:, :1]
            cross = np.where(nowhere, of_common, cross + of_common if Y.related else cross)
        return np.asarray(dual @ cross.T)

    def update(self, Y: Split, variance: Array, innovations: Array) -> Update:
        """Increments of M members from ``innovations`` (M, K), with anomalies ``Y`` (N, K), error ``variance`` (K,)."""
        dual = cho_solve(cho_factor(self.between(Y, Y) + np.diag(variance)), innovations.T).T
        return lambda part, anomalies: self.along(part, anomalies, Y, dual)


@dataclass(frozen=True)
class ByCorrelation:
    """``threshold`` on the size of correlations; default 3/√N."""

    threshold: float | None = None

    def update(self, split: Split, variance: Array, innovations: Array) -> Update:
        """As :meth:`ByDistance.update`."""
        Y, n_members = split.whole, len(split.placed)
        least = CHANCE / np.sqrt(n_members) if self.threshold is None else self.threshold
        covariance = Y.T @ Y / (n_members - 1)
        spread = np.sqrt(np.diag(covariance))

        def increments(part: slice, anomalies: Array) -> Array:
            cross = anomalies.T @ Y / (n_members - 1)
            size = np.sqrt(np.einsum("ij,ij->j", anomalies, anomalies) / (n_members - 1))
            kept = np.abs(cross) > least * np.outer(size, spread)
            change = np.zeros((len(innovations), len(size)))
            counts = kept.sum(axis=1)
            for count in np.unique(counts[counts > 0]).tolist():
                of = np.flatnonzero(counts == count)
                near = np.nonzero(kept[of])[1].reshape(-1, count)
                sets, which = (
                    (near, np.arange(len(of))) if count <= FEW else np.unique(near, axis=0, return_inverse=True)
                )
                own = covariance[sets[:, :, None], sets[:, None, :]] + variance[sets][:, :, None] * np.eye(count)
                if count <= FEW:
                    gain = np.linalg.solve(own, cross[of[:, None], near][:, :, None])[:, :, 0]
                    change[:, of] = np.einsum("cm,jcm->jc", gain, innovations[:, near])
                    continue
                for k, (matrix, readings) in enumerate(zip(own, sets, strict=True)):
                    cells = of[which.ravel() == k]
                    change[:, cells] = (
                        np.linalg.solve(matrix, innovations[:, readings].T).T @ cross[np.ix_(cells, readings)].T
                    )
            return change

        return increments


Gain = ByDistance | ByCorrelation


def parts(size: int, width: int) -> Iterator[slice]:
    """Cells in parts, of which each takes memory in proportion to ``width``."""
    step = max(1, PART // width)
    for first in range(0, size, step):
        yield slice(first, min(first + step, size))
