"""Series: readings of one observable, each at its time and, of a field, at its place. A data set is a list of them."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Self

import numpy as np
import numpy.typing as npt

from en4dvar.data.noise import Noise
from en4dvar.model.forward import Observable
from en4dvar.model.state import Array, hold_floats
from en4dvar.plumbing.caution import Caution
from en4dvar.plumbing.errors import DataError, retold


@dataclass(frozen=True)
class Places:
    """Where on a field each of K readings was taken: reading k is Σ_j ``shares``_kj field[``indices``_kj].

    ``indices`` (K, m) of the field's components, ``shares`` (K, m); ``positions`` (K,) as they were stated, in
    ``unit``, for the record.
    """

    indices: npt.NDArray[np.intp]
    shares: Array
    positions: Array
    unit: str = "1"

    @classmethod
    def at_indices(cls, indices: npt.ArrayLike) -> Self:
        """Places at components counted from 0, (K,)."""
        chosen = np.asarray(indices, dtype=np.intp)
        return cls(chosen[:, None], np.ones((len(chosen), 1)), chosen.astype(float))

    @classmethod
    def at_coordinates(cls, positions: npt.ArrayLike, coordinates: Array, unit: str = "1") -> Self:
        """Linear interpolation between components at ``coordinates`` (n,), in any order; ``positions`` (K,) within.
        Raises :class:`DataError` for a position outside.
        """
        asked, order = np.asarray(positions, dtype=float), np.argsort(coordinates, kind="stable")
        along = coordinates[order]
        outside = np.flatnonzero(~((asked >= along[0]) & (asked <= along[-1])))
        if len(outside):
            raise DataError(f"place {asked[outside[0]]:g} {unit} lies outside {along[0]:g} to {along[-1]:g} {unit}")
        above = np.clip(np.searchsorted(along, asked), 1, len(along) - 1)
        share = (asked - along[above - 1]) / (along[above] - along[above - 1])
        indices = np.stack([order[above - 1], order[above]], axis=1)
        return cls(indices, np.stack([1 - share, share], axis=1), asked, unit)

    def __getitem__(self, which: slice | npt.NDArray[np.intp] | npt.NDArray[np.bool_]) -> Self:
        return type(self)(self.indices[which], self.shares[which], self.positions[which], self.unit)

    @property
    def single(self) -> bool:
        """True if all readings were taken at the same place."""
        return bool(np.all(self.indices == self.indices[0]) and np.all(self.shares == self.shares[0]))

    def read(self, values: Array, rows: npt.NDArray[np.intp] | slice = slice(None)) -> Array:
        """(…, K) of a field at T instants, (…, T, n), each reading at one of the ``rows`` (K,)."""
        instants = np.arange(values.shape[-2])[rows]
        return np.asarray(np.sum(values[..., instants[:, None], self.indices] * self.shares, axis=-1))


@dataclass(frozen=True)
class Series:
    """Readings of one observable.

    Attributes
    ----------
    observable: what was read.
    times: (K,) in the model's time unit; increasing, but for a field, which may be read at many places at once.
    values: (K,) in the observable's unit.
    noise: the errors of these readings (:func:`en4dvar.data.noise.noise_of`).
    weights: (K,) β ≥ 0; None: 1.
    name: of the series; default: the observable's. group: what it is balanced as (:func:`balanced`); default: its name.
    places: where on a field the readings were taken; None of an observable with one value at a time.
    source, scalars, doubts, error_unit, next_end, zero: as of :class:`~en4dvar.data.observations.Observations`.
    continued: times, values and errors of these readings and those after the window; None where there are none.
    """

    observable: Observable
    times: Array
    values: Array
    noise: Noise
    weights: Array | None = None
    name: str = ""
    group: str = ""
    places: Places | None = None
    source: str = ""
    scalars: Mapping[str, float] = field(default_factory=dict)
    doubts: tuple[Caution, ...] = ()
    continued: tuple[Array, Array, Noise] | None = None
    error_unit: str = ""
    next_end: str = ""
    zero: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "name", self.name or self.observable.name)
        object.__setattr__(self, "group", self.group or self.name)
        if self.weights is None:
            object.__setattr__(self, "weights", np.ones(len(self.times)))
        with retold((TypeError, ValueError), DataError, f"{self.name}: "):
            hold_floats(self, "times", "values", "weights")


@dataclass(frozen=True)
class Part:
    """Which readings of a data set are those of a series, ``begin`` to ``end``, what they are of and where."""

    name: str
    observable: Observable
    begin: int
    end: int
    places: Places | None = None
    group: str = ""

    @property
    def where(self) -> slice:
        """Their places among the readings of the data set."""
        return slice(self.begin, self.end)

    @property
    def has_path(self) -> bool:
        """True if it has one value at a time, so that it can be drawn as a curve."""
        return self.places is None or self.places.single

    def read_along(self, values: Array) -> Array:
        """(…, M) of what the observable is at M instants, (…, M) or of a field (…, M, n), at the one place."""
        if self.places is None:
            return values
        return np.asarray(values[..., self.places.indices[0]] @ self.places.shares[0])


def balanced(weights: Array, groups: npt.ArrayLike) -> Array:
    """Weights (K,) whose sum is the same over each of the ``groups`` (K,), labels; the total stays as it is.

    A group counts as if it had as many readings as every other; one whose weights are all zero keeps them.

    >>> balanced(np.ones(6), ["a", "b", "b", "b", "b", "b"])
    array([3. , 0.6, 0.6, 0.6, 0.6, 0.6])
    """
    _, label = np.unique(np.asarray(groups), return_inverse=True)
    sums = np.bincount(label, weights)
    share = weights.sum() / max(1, np.count_nonzero(sums))
    return np.asarray(weights * np.divide(share, sums, out=np.zeros_like(sums), where=sums > 0)[label])
