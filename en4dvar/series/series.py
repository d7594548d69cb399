"""A series of observation vectors, the whitening of its errors, and how the readings of a data set become one."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_array

from en4dvar.data.noise import Correlation
from en4dvar.data.noise.make import correlation_of
from en4dvar.data.observations import Observations
from en4dvar.data.series import Part, Places
from en4dvar.model.forward import Observable, ObservationOperator, Trajectory
from en4dvar.model.state import Array, Indices
from en4dvar.plumbing.errors import DataError


@dataclass(frozen=True)
class CycleSeries:
    """Observations ``values`` (K, p) at increasing ``times`` (K,) ≥ 0 with errors R_k = D_k C D_k, D_k = diag(std_k).

    NaN among the values is no observation. ``std`` is (p,) or (K, p). ``correlation`` C (p, p), full or block diagonal,
    is that of the errors of one instant; None: independent. Errors of different instants are independent. ``names``
    (p,) are those of what was observed, for the record.

    Raises ValueError: shapes that do not fit, times that do not increase from zero, std that is not positive.
    """

    times: Array
    values: Array
    std: Array
    correlation: Correlation | None = None
    names: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.values.ndim != 2 or self.times.shape != self.values.shape[:1]:
            raise ValueError(f"values {self.values.shape} do not match times {self.times.shape}")
        if self.std.shape not in (self.values.shape, self.values.shape[1:]):
            raise ValueError(f"std {self.std.shape} does not match values {self.values.shape}")
        if not (np.all(np.diff(self.times) > 0) and np.all(self.times[:1] >= 0) and np.all(self.std > 0)):
            raise ValueError("times must increase from zero and std must be positive")
        if self.correlation is not None:
            self.correlation.check_size(self.values.shape[1])

    def whiten(self, k: int, reference: Array, anomalies: Array) -> tuple[Array, Array]:
        """d = R_k^{-1/2}(y_k − reference) (p,) and S = R_k^{-1/2} anomaliesᵀ (p, N) of anomalies (N, p).

        Rows of what was not observed are zero.
        """
        std = self.std if self.std.ndim == 1 else self.std[k]
        d, s, there = (self.values[k] - reference) / std, anomalies / std, np.isfinite(self.values[k])
        d, s = np.where(there, d, 0.0), np.where(there, s, 0.0)
        if self.correlation is not None and there.any():
            whole = self.correlation
            among = whole if there.all() else Correlation(whole.matrix[np.ix_(there, there)])
            d[there], s[:, there] = among.decorrelated(d[there]), among.decorrelated(s[:, there])
        return d, s.T


@dataclass(frozen=True)
class AtPlaces:
    """H that reads a field at places (q,), the same at every instant."""

    whole: ObservationOperator
    places: Places

    def __call__(self, trajectory: Trajectory) -> Array:
        values = self.whole(trajectory)
        return np.asarray(np.sum(values[..., self.places.indices] * self.places.shares, axis=-1))


def aligned(observations: Observations, parts: Sequence[Part]) -> tuple[tuple[Observable, ...], CycleSeries]:
    """The observation operators of an instant, and the series; ``parts`` say which readings are of what.

    Weights divide variances; a reading of weight zero is none.

    Raises DataError: errors of different instants that are not independent, of a timing error, robust or with a
    discrepancy; a field read twice at one place and instant.
    """
    noise, where = observations.noise, observations.source or observations.name
    if np.any(noise.time_std > 0) or noise.attributes() or not noise.quadratic:
        raise DataError(f"{where}: a series takes plain Gaussian errors: no time_std, robust, bounds or discrepancy")
    times, row = observations.instants
    row = np.arange(len(times)) if isinstance(row, slice) else row
    columns = np.empty(len(observations), dtype=np.intp)
    names: list[str] = []
    observables = []
    for part in parts:
        own, observable, labels = _columns(part)
        columns[part.where] = len(names) + own
        names += labels
        observables.append(observable)
    values, std = np.full((len(times), len(names)), np.nan), np.ones((len(times), len(names)))
    counts = observations.weights > 0
    if len(np.unique(row[counts] * len(names) + columns[counts])) < counts.sum():
        raise DataError(f"{where}: a field is read twice at one place and instant; average the readings")
    values[row[counts], columns[counts]] = observations.values[counts]
    std[row[counts], columns[counts]] = (observations.std / np.sqrt(np.where(counts, observations.weights, 1)))[counts]
    correlation = None
    if not noise.independent:
        correlation = _of_an_instant(correlation_of(noise), row, columns, len(names), where)
    return tuple(observables), CycleSeries(times, values, std, correlation, tuple(names))


def _columns(part: Part) -> tuple[Indices, Observable, list[str]]:
    """Which column, of those of the part, each reading stands in, what gives the columns, and their names."""
    own = replace(part.observable, name=part.name)
    if part.places is None:
        return np.zeros(part.end - part.begin, dtype=np.intp), own, [part.name]
    places = part.places
    _, first, column = np.unique(
        np.hstack([places.indices, places.shares]), axis=0, return_index=True, return_inverse=True
    )
    at = places[first]
    names = [f"{part.name} at {position:g}" for position in at.positions]
    return column.ravel(), replace(own, operator=AtPlaces(part.observable.operator, at)), names


def _of_an_instant(whole: csr_array, row: Indices, columns: Indices, size: int, where: str) -> Correlation:
    """The correlation of the columns, the same at every instant, from that of all readings. Raises DataError."""
    matrix = np.eye(size)
    i, j = whole.nonzero()
    values = whole[i, j]
    matrix[columns[i], columns[j]] = values
    there = np.zeros((row.max() + 1, size))
    there[row, columns] = 1
    pairs = np.einsum("ti,ij,tj->", there, matrix != 0, there)  # of one instant that this matrix correlates
    if np.any(row[i] != row[j]) or len(i) != pairs or np.any(matrix[columns[i], columns[j]] != values):
        raise DataError(
            f"{where}: a series takes errors that are independent from instant to instant, and correlated alike at each"
        )
    return Correlation(matrix)
