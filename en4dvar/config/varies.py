"""``varies:`` of a parameter and ``model_error:`` of the state: what changes at knots in time."""

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import model_validator

from en4dvar.config.context import SPREAD, Context, Made, Spread, parse_spread, quantity, subject_unit, time_unit
from en4dvar.config.initial_state import of_fields
from en4dvar.config.schema import Section
from en4dvar.config.validate import Faults
from en4dvar.data.observations import Observations
from en4dvar.inputs.window import maxima
from en4dvar.model.forward import ForwardModel
from en4dvar.model.state import Field
from en4dvar.plumbing.errors import ConfigError
from en4dvar.priors.prior import PriorTerm
from en4dvar.priors.varying import StateChanges

MOST_KNOTS = 1000


class Estimated(Spread):
    """A standard deviation that is estimated, by that of its half-normal prior."""


class Knots(Section):
    """When something changes: at regular knots, or at given ones."""

    every: Annotated[float | None, quantity(time_unit, "positive")] = None
    """Length of a piece, e.g. 5 us: knots at its multiples, from the model's time zero to the last observation."""
    at: Literal["maxima"] | tuple[Annotated[float, quantity(time_unit, "positive")], ...] | None = None
    """The knots, in increasing order, from the model's time zero; instead of ``every``. Or maxima: the highest reading
    between each two minima in the window."""

    @classmethod
    def rules(cls, keys: Mapping[str, Any], context: Context, faults: Faults) -> None:
        if ("every" in keys) == ("at" in keys):
            faults.add((), "give either every (length of a piece) or at (list of knots)")

    @model_validator(mode="after")
    def _increasing(self) -> Self:
        at = None if self.at == "maxima" or self.at is None or None in self.at else self.at
        with Faults() as faults:
            if at is not None and (not at or any(b <= a for a, b in itertools.pairwise(at))):
                faults.add(("at",), "give at least one knot, and each later than the one before it")
        return self

    def knots(self, observations: Observations) -> tuple[float, ...]:
        """Those for a window of observations. Raises :class:`ConfigError`: none is of use."""
        times, last = observations.times, float(observations.times[-1])
        if self.at == "maxima":
            if observations.parts or not len(tops := maxima(observations.values)):
                raise ConfigError("there is no maximum between two minima of one series in the window", "at")
            return tuple(times[tops].tolist())
        if self.at is not None:
            if not self.at[0] < last:
                raise ConfigError("all knots lie after the last observation", "at")
            return self.at
        count, width = int(min(last // self.every, MOST_KNOTS + 1)) if self.every else 0, self.every or 1.0
        if count > MOST_KNOTS:
            raise ConfigError(f"more than {MOST_KNOTS} pieces in the window", "every")
        instants = tuple(k * width for k in range(1, count + 1) if k * width < last)
        if not instants:
            raise ConfigError("the last observation comes before the end of the first piece", "every")
        return instants


def _change_std(text: Any, context: Context) -> Spread:
    return Estimated(0.5, relative=True) if text == "estimated" else parse_spread(text, subject_unit(context))


class VariesSection(Knots):
    """A parameter that varies in time: constant pieces, and at each knot between two a random change."""

    std: Annotated[Spread, Made(_change_std)]
    """Standard deviation of each change: in % of the value (lognormal: of its logarithm), or in the parameter's
    unit, which holds at the centre of the prior; or ``estimated``, with a half-normal prior of 50 %."""

    @property
    def estimated(self) -> bool:
        """True if ``std`` is that of the prior of the changes' standard deviation."""
        return isinstance(self.std, Estimated)

    def std_of(self, term: PriorTerm) -> float:
        """Standard deviation of each change in the coordinate of the prior of its parameter.

        Raises :class:`ConfigError`, its path the key: a share of a mean that is zero.
        """
        centre = float(term.to_physical(np.array(term.mean)))
        if self.std.relative and centre == 0:
            raise ConfigError(f"relative to the mean, which is zero; give it in {term.parameter.unit}", "std")
        return float(self.std.absolute(centre) / term.slope(term.mean))


class ModelErrorSection(Knots):
    """A field of the state that changes at knots, by something the model does not know."""

    std: Annotated[Spread, SPREAD]
    """Standard deviation of each change: in the field's unit (added to it), or in % (a factor)."""


@dataclass(frozen=True)
class ErrorOf:
    """The model error of a field of the state, as a file states it."""

    field: Field
    spec: ModelErrorSection

    def changes(self, model: ForwardModel, observations: Observations) -> StateChanges:
        """Over a window of observations. Raises :class:`ConfigError`, its path the faulty key."""
        std = self.spec.std
        if self.field.name not in model.layout.names and not std.relative:
            raise ConfigError("it is multiplied at each knot: give the std in %", "std")
        return StateChanges.of(model, self.field, self.spec.knots(observations), std.value, std.relative)


MODEL_ERROR = of_fields(
    ModelErrorSection, "write varies behind its prior", lambda section, field: ErrorOf(field, section), changes=True
)
