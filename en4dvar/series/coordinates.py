"""Coordinates in which the ensemble of a series is Gaussian: logarithms of what is positive, parameters as their prior.

The analysis moves members along straight lines; in these coordinates none leaves the range of a parameter.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from en4dvar.model.forward import ForwardModel
from en4dvar.model.state import Array
from en4dvar.priors.prior import Prior, PriorTerm


@dataclass(frozen=True)
class EnsembleCoordinates:
    """``terms``: columns of the state and priors of the parameters that they hold; ``logarithms``: columns that are
    positive, and the ``lowest`` values, which these do not reach.
    """

    terms: tuple[tuple[int, PriorTerm], ...] = ()
    logarithms: tuple[int, ...] = ()
    lowest: tuple[float, ...] = ()

    @classmethod
    def of(cls, model: ForwardModel, prior: Prior | None, positive: Sequence[str] = ()) -> "EnsembleCoordinates":
        """For the parameters of ``prior`` that the state has fields of; fields named in ``positive`` by logarithms, of
        what they exceed a lower bound by, where they have one.
        """
        held = [term for term in (prior.terms if prior else ()) if term.parameter.name in model.layout.names]
        low = {field.name: max(0.0, field.bounds[0]) for field in model.layout}
        columns = [(c, low[name]) for name in positive for c in range(*model.layout[name].indices(model.layout.size))]
        return cls(
            tuple((model.layout[t.parameter.name].start, t) for t in held if t.transform != "normal"),
            tuple(column for column, _ in columns),
            tuple(lowest for _, lowest in columns),
        )

    def to_physical(self, x: Array) -> Array:
        """States (…, n) of a model from those of the ensemble."""
        if not self.terms and not self.logarithms:
            return x
        physical = np.array(x)
        with np.errstate(over="ignore"):
            for column, term in self.terms:
                physical[..., column] = term.to_physical(x[..., column])
            physical[..., self.logarithms] = self.lowest + np.exp(x[..., self.logarithms])
        return physical

    def from_physical(self, states: Array, origin: Array) -> Array:
        """The other way, of paths (N, K, n) that began at ``origin`` (N, n): parameters are constant along a path.

        The logarithm of what is not positive is not finite.
        """
        if not self.terms and not self.logarithms:
            return states
        coordinates = np.array(states)
        for column, _ in self.terms:
            coordinates[..., column] = origin[:, None, column]
        with np.errstate(invalid="ignore", divide="ignore"):
            coordinates[..., self.logarithms] = np.log(states[..., self.logarithms] - np.array(self.lowest))
        return coordinates
