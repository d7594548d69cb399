"""What an experiment says by itself, as far as a joint estimate needs it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from en4dvar.model.state import Array
from en4dvar.priors.prior import Prior


@dataclass(frozen=True)
class Single:
    """The estimate of one experiment by itself: mode (n,) and posterior precision (n, n), in units of the prior."""

    mode: Array
    precision: Array

    @classmethod
    def of_physical(cls, prior: Prior, members: Array, mode: Array) -> Single:
        """From the members (N, n) alive and the mode (n,) of a posterior. Raises ValueError outside a map's range."""
        z = (prior.from_physical(np.vstack([members, mode])) - prior.mean) / prior.std
        return cls(z[-1], np.linalg.inv(np.atleast_2d(np.cov(z[:-1].T))))
