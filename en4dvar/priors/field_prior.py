"""Priors of whole fields: the initial values of a field of the state, correlated by a function of distance.

Cells on a regular grid, in any number of dimensions, are drawn by circulant embedding: on a torus the covariance is
diagonal in Fourier space, and a torus that is larger than the grid by ten correlation lengths has the kernel's
covariances within it to 1e-4 (Dietrich & Newsam 1997, SIAM J. Sci. Comput. 18, 1088). Other places need a matrix.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy  # its fft where it is used: a fifth of what every command imports

from en4dvar.model.state import Array, Field
from en4dvar.plumbing.errors import ConfigError
from en4dvar.priors.dependence import KERNELS, MOST_CORRELATED, correlation_of_places
from en4dvar.priors.prior import member_stream

REACH = 10.0  # correlation lengths between a grid and its image on the torus
UNEVEN = 1e-6  # of a step: a grid whose steps differ by less is regular
LEFT_OUT = 1e-6  # share of the variance of the modes that are not estimated
MOST_CELLS = 2000  # of a field that is told by modes: their matrix takes 32 MB and some seconds


@dataclass(frozen=True)
class FieldPrior:
    """The prior of the cells of ``field``: N(the model's value, std² C), C a ``kernel`` of distance/``length``.

    ``std`` is in the field's unit; where ``relative`` it is that of the logarithm of a factor on the model's values.
    ``length`` is in the unit of the field's coordinates. ``modes``: how many of them tell the field where nothing is
    localised, by default all but :data:`LEFT_OUT` of the variance.

    Raises :class:`ConfigError`: a field without coordinates, or more cells than a matrix holds that are on no regular
    grid.
    """

    field: Field
    std: float
    kernel: str
    length: float
    relative: bool = False
    modes: int | None = None

    def __post_init__(self) -> None:
        if self.field.coordinates is None:
            raise ConfigError(f"the model gives no coordinates for {self.field.name}, so that no distance is known")
        if self.grid is None and self.field.size > MOST_CORRELATED:
            cells = f"{self.field.name} has {self.field.size} cells on no regular grid"
            raise ConfigError(f"{cells}; at most {MOST_CORRELATED} can be drawn from a matrix")

    @cached_property
    def places(self) -> Array:
        """(size, D)."""
        return places_of(self.field)

    @cached_property
    def grid(self) -> tuple[tuple[int, ...], tuple[float, ...]] | None:
        """Cells along each axis, and the steps between them; None of cells on no regular grid."""
        return regular_grid(self.places)

    def draw(self, seed: int, member: int) -> Array:
        """A member's addition to the field, or the logarithms of its factors (size,), from a stream of its own."""
        stream = member_stream(seed, f"field {self.field.name}", member)
        if self.grid is None:
            return np.asarray(self.std * (self._root @ stream.standard_normal(self.field.size)))
        (shape, _), (wide, amplitudes) = self.grid, self._torus
        white = scipy.fft.rfftn(stream.standard_normal(wide))
        inside = tuple(slice(0, side) for side in shape)
        return np.asarray(self.std * scipy.fft.irfftn(amplitudes * white, wide)[inside].ravel())

    def applied(self, base: Array, drawn: Array) -> Array:
        """Fields (…, size) of the model's values ``base`` and what members add, or of their factors."""
        return np.asarray(base * np.exp(drawn) if self.relative else base + drawn)

    def patterns(self) -> Array:
        """The largest modes (m, size) of the covariance, each times its standard deviation: a field is their sum, with
        coefficients N(0, 1) of their own (Karhunen & Loève). Raises :class:`ConfigError`: too many cells.
        """
        name, size = self.field.name, self.field.size
        if size > MOST_CELLS:
            words = f"{name} has {size} cells; more than {MOST_CELLS} need a localised gain, e.g. {{radius: 10}}"
            raise ConfigError(words, "assimilation.localisation")
        values, vectors = np.linalg.eigh(correlation_of_places(self.kernel, self.places, self.length))
        values, vectors = np.maximum(values[::-1], 0.0), vectors[:, ::-1]
        left = 1 - np.cumsum(values) / values.sum()
        count = int(np.sum(left > LEFT_OUT)) + 1 if self.modes is None else min(self.modes, size)
        signs = np.sign(vectors[np.abs(vectors).argmax(axis=0), np.arange(size)])
        return np.asarray(self.std * (np.sqrt(values) * vectors * signs).T[:count])

    @cached_property
    def _root(self) -> Array:
        return np.asarray(np.linalg.cholesky(correlation_of_places(self.kernel, self.places, self.length)))

    @cached_property
    def _torus(self) -> tuple[tuple[int, ...], Array]:
        """Cells along the axes of the torus, and roots of its eigenvalues, none negative; the variance is kept."""
        assert self.grid is not None
        shape, steps = self.grid
        wide = tuple(
            scipy.fft.next_fast_len(side + math.ceil(REACH * self.length / step), real=True) if side > 1 else 1
            for side, step in zip(shape, steps, strict=True)
        )
        cells = [np.arange(count) for count in wide]
        apart = [np.minimum(i, len(i) - i) * step / self.length for i, step in zip(cells, steps, strict=True)]
        squares = np.asarray(sum(np.ix_(*(along**2 for along in apart))))
        values = np.maximum(scipy.fft.rfftn(KERNELS[self.kernel](np.sqrt(squares))).real, 0.0)
        values /= scipy.fft.irfftn(values, wide).flat[0]
        return wide, np.sqrt(values)


def places_of(field: Field) -> Array:
    """Coordinates (size, D) of the components of a field that has some."""
    assert field.coordinates is not None
    return np.asarray(field.coordinates, dtype=float).reshape(field.size, -1)


def regular_grid(places: Array) -> tuple[tuple[int, ...], tuple[float, ...]] | None:
    """Cells along each axis and the steps, of places (n, D) that are a regular grid whose last axis runs fastest.

    >>> regular_grid(np.array([[0.0, 0.0], [0.0, 2.0], [1.0, 0.0], [1.0, 2.0]]))
    ((2, 2), (1.0, 2.0))
    """
    axes = [np.unique(along) for along in places.T]
    shape = tuple(map(len, axes))
    if math.prod(shape) != len(places):
        return None
    steps = tuple(float(axis[-1] - axis[0]) / max(1, len(axis) - 1) or 1.0 for axis in axes)
    even = np.indices(shape, dtype=float).reshape(len(shape), -1).T * steps + [axis[0] for axis in axes]
    return (shape, steps) if np.all(np.abs(places - even) <= UNEVEN * np.array(steps)) else None
