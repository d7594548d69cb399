"""H of every series of a data set as one function of a path: at which instants and places it is read."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from en4dvar.data.series import Part
from en4dvar.ensemble.members import MisshapenError
from en4dvar.model.forward import RateOperator
from en4dvar.model.state import Array
from en4dvar.plumbing.errors import ConfigError
from en4dvar.problem import InverseProblem

Indices = npt.NDArray[np.intp] | slice


@dataclass(frozen=True)
class Readout:
    """(…, K + P M) of a path at T instants: the K readings of all parts, then the curves of the P parts that have one.

    ``operators`` are those of the ``parts``, or their rates; ``rows`` (K,) says at which instant each reading was
    taken, ``along`` (M,) those that a curve is read at.
    """

    operators: tuple[Callable[[Any], Array], ...]
    parts: tuple[Part, ...]
    n_times: int
    rows: Indices
    along: Indices

    def __call__(self, path: Any) -> Array:
        predictions = []
        curves = []
        for operator, part in zip(self.operators, self.parts, strict=True):
            values, of_field = np.asarray(operator(path)), part.places is not None
            if values.ndim < 1 + of_field or values.shape[-1 - of_field] != self.n_times:
                raise MisshapenError
            rows = self.rows if isinstance(self.rows, slice) else self.rows[part.where]
            if part.places is None:
                predictions.append(values[..., rows])
            else:
                predictions.append(part.places.read(values, rows))
            if part.has_path:
                at = values[..., self.along] if part.places is None else values[..., self.along, :]
                curves.append(part.read_along(at))
        return np.concatenate([*predictions, *curves], axis=-1)


def operators_of(parts: Sequence[Part], needs_rates: str = "") -> tuple[Callable[[Any], Array], ...]:
    """The operators of the parts or, where something ``needs_rates``, by its name, their rates.

    Raises :class:`ConfigError` where the model does not provide a rate.
    """
    operators = list[Callable[[Any], Array]]()
    for part in parts:
        operator, name = part.observable.operator, part.observable.name
        if needs_rates and not isinstance(operator, RateOperator):
            raise ConfigError(f"{needs_rates} needs the rate of {name}, which the model does not provide")
        operators.append(operator.rate if needs_rates and isinstance(operator, RateOperator) else operator)
    return tuple(operators)


def batched(problem: InverseProblem) -> bool:
    """True if all operators take a :class:`~en4dvar.model.batch.Batch`."""
    return all(getattr(part.observable.operator, "batched", False) for part in problem.parts)
