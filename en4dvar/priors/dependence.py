"""Parameters whose priors depend on each other: a correlation matrix of their transformed coordinates.

    x = mean + std · L z,   L Lᵀ = C,   z ~ N(0, I)

C is the correlation of the values of ``normal`` parameters, of the logarithms of ``lognormal`` ones, of the logits or
Gaussian scores of the others (a Gaussian copula): each parameter has the prior that is stated for it alone.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from scipy.linalg import solve_triangular

from en4dvar.model.state import Array
from en4dvar.plumbing.errors import ConfigError

MOST_CORRELATED = 5000  # names in one block: its root takes 200 MB and 2 s
LEAST_INDEPENDENT = 1e-10  # share of its variance that a parameter must keep, given those before it
NUGGET = 1e-8  # share of the variance that close neighbours keep to themselves: a smooth kernel is singular to rounding
KERNELS: Mapping[str, Callable[[Array], Array]] = {  # of distances in correlation lengths
    "exponential": lambda r: np.exp(-r),
    "matern-3/2": lambda r: (1 + np.sqrt(3) * r) * np.exp(-np.sqrt(3) * r),
    "matern-5/2": lambda r: (1 + np.sqrt(5) * r + 5 / 3 * r**2) * np.exp(-np.sqrt(5) * r),
    "gaussian": lambda r: np.exp(-0.5 * r**2),
}
KernelName = Literal["exponential", "matern-3/2", "matern-5/2", "gaussian"]


def correlation_of_places(kernel: str, places: Array, length: float) -> Array:
    """Correlation matrix (m, m) of what has ``places`` (m, D), by a kernel of their distances over ``length``."""
    from scipy.spatial.distance import cdist  # not needed to import the package

    correlation = (1 - NUGGET) * KERNELS[kernel](cdist(places, places) / length)
    np.fill_diagonal(correlation, 1.0)
    return np.asarray(correlation)


@dataclass(frozen=True, eq=False)
class Dependence:
    """``names`` (m) of parameters with the correlation ``matrix`` (m, m), independent of all others.

    ``members`` (N, m): the standardised members of an ensemble whose correlation the matrix is. A prior ensemble of N
    members consists of these.

    Raises :class:`ConfigError`: no correlation matrix, singular, or too large.
    """

    names: tuple[str, ...]
    matrix: Array
    members: Array | None = None

    def __post_init__(self) -> None:
        m, words = len(self.names), f"correlation of {', '.join(self.names[:6])}{' …' if len(self.names) > 6 else ''}"
        if m > MOST_CORRELATED:
            raise ConfigError(f"{words}: {m} parameters; one matrix holds at most {MOST_CORRELATED}")
        if len(set(self.names)) != m:
            raise ConfigError(f"{words}: a name occurs twice")
        if self.matrix.shape != (m, m):
            raise ConfigError(f"{words}: the matrix is {' by '.join(map(str, self.matrix.shape))}, not {m} by {m}")
        if not np.all(np.isfinite(self.matrix)) or np.max(np.abs(self.matrix - self.matrix.T)) > 1e-9:
            raise ConfigError(f"{words}: the matrix must be symmetric and of finite numbers")
        if np.max(np.abs(np.diag(self.matrix) - 1)) > 1e-9:
            raise ConfigError(f"{words}: the diagonal must be 1; standard deviations are those of the parameters")
        try:
            least = float(np.diag(self.root).min()) ** 2
        except np.linalg.LinAlgError:
            least = 0.0
        if least < LEAST_INDEPENDENT:
            raise ConfigError(f"{words}: the matrix is not positive definite, as a correlation must be")

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Dependence) and self.names == other.names and np.array_equal(self.matrix, other.matrix)

    def __hash__(self) -> int:
        return hash(self.names)

    @cached_property
    def root(self) -> Array:
        """L (m, m), lower triangular."""
        return np.asarray(np.linalg.cholesky(self.matrix))

    def whitened(self, y: Array) -> Array:
        """L⁻¹ y of standardised coordinates (…, m)."""
        flat = y.reshape(-1, y.shape[-1]).T
        return np.asarray(solve_triangular(self.root, flat, lower=True).T.reshape(y.shape))

    def with_first(self, names: Collection[str]) -> "Dependence":
        """The same with those of its parameters that are in ``names`` before the others: their white coordinates then
        are functions of themselves alone.
        """
        order = sorted(range(len(self.names)), key=lambda i: self.names[i] not in names)
        members = None if self.members is None else self.members[:, order]
        return Dependence(tuple(self.names[i] for i in order), self.matrix[np.ix_(order, order)], members)

    def among(self, names: Sequence[str]) -> "Dependence | None":
        """The block of those of its parameters that are in ``names``; None where fewer than two are left."""
        kept = [i for i, name in enumerate(self.names) if name in names]
        if len(kept) == len(self.names):
            return self
        if len(kept) < 2:
            return None
        members = None if self.members is None else self.members[:, kept]
        return Dependence(tuple(self.names[i] for i in kept), self.matrix[np.ix_(kept, kept)], members)
