"""What is unsure of the state: its initial value (``initial_state:``), and what changes at knots in time.

The latter is ``varies:`` of a parameter and ``model_error:`` of fields of the state.
"""

import itertools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal, NamedTuple, TypeVar

import numpy as np
from annotated_types import Ge

from en4dvar.config.context import Context, Faults, Made, read_each
from en4dvar.config.quantities import SPREAD, Spread, parse_spread, quantity, subject_unit, time_unit
from en4dvar.config.schema import Section
from en4dvar.data.extrema import maxima
from en4dvar.data.observations import Observations
from en4dvar.model.forward import ForwardModel
from en4dvar.model.state import Field, Parameter
from en4dvar.plumbing.errors import ConfigError
from en4dvar.plumbing.hints import shown, suggest
from en4dvar.priors.dependence import KernelName
from en4dvar.priors.field_prior import FieldPrior
from en4dvar.priors.prior import PriorTerm
from en4dvar.priors.varying import StateChanges
from en4dvar.problem import StatePerturbation

S = TypeVar("S", bound=Section)
T = TypeVar("T")


class Perturbed(NamedTuple):
    """A field estimated as a single number, and the effect of that number on the initial state."""

    term: PriorTerm
    perturbation: StatePerturbation


Initial = Perturbed | FieldPrior


def modes_of(prior: FieldPrior) -> list[Perturbed]:
    """A field as the sum of its modes. Raises :class:`ConfigError`: it has too many cells."""
    name, told = prior.field.name, []
    for k, pattern in enumerate(prior.patterns(), 1):
        parameter = Parameter(f"{name}_mode_{k}", "1", label=f"mode {k} of the initial {name}")
        effect = StatePerturbation(parameter, name, prior.relative, tuple(pattern.tolist()), prior)
        told.append(Perturbed(PriorTerm.normal(parameter, 0.0, 1.0), effect))
    return told


def perturbation(field: Field, std: str | float | Spread) -> Perturbed:
    """N(0, std²) added to the field, or, for a std in %, a factor whose logarithm is N(0, std²). Raises
    :class:`UnitError`: a unit that is not the field's. :class:`ConfigError`: a std that is not positive.
    """
    name, spread = f"initial_{field.name}", std if isinstance(std, Spread) else parse_spread(std, field.unit)
    if spread.relative:
        label = f"initial {field.name} relative to the model's"
        parameter = Parameter(name, "1", "lognormal", (0.0, float("inf")), label)
        term = PriorTerm.lognormal(parameter, 1.0, spread.value)
        return Perturbed(term, StatePerturbation(parameter, field.name, relative=True))
    parameter = Parameter(name, field.unit, label=f"initial {field.name} beyond the model's")
    return Perturbed(PriorTerm.normal(parameter, 0.0, spread.value), StatePerturbation(parameter, field.name))


class InitialSpread(Section):
    """Spread of the initial value of a state field: in its unit (added), or in ``%`` (a factor).

    One number for all components, or, with ``kernel`` and ``length``, each component by itself, correlated by a
    function of their distance: cell by cell where the scheme is localised, else as the sum of its largest modes.
    """

    std: Annotated[Spread, SPREAD]
    """Standard deviation: in the field's unit (added to it), or in % (a factor)."""
    kernel: KernelName | None = None
    """Correlation of the components as a function of their distance."""
    length: Annotated[float, quantity(lambda context: str(context.subject.coordinate_unit), "positive")] | None = None
    """Correlation length of the kernel, in the unit of the field's coordinates."""
    modes: Annotated[int, Ge(1)] | None = None
    """How many modes are estimated where nothing is localised; by default those with all but 1e-6 of the variance."""

    @classmethod
    def rules(cls, keys: Mapping[str, Any], context: Context, faults: Faults) -> None:
        for key, other in (("kernel", "length"), ("length", "kernel")):
            if key in keys and other not in keys:
                faults.add((key,), f"kernel and length go together; give {other} as well", at_key=True)
        if "modes" in keys and "kernel" not in keys:
            faults.add(("modes",), "modes are those of a kernel; give kernel and length as well", at_key=True)
        if "kernel" in keys and context.subject.coordinates is None:
            name = context.subject.name
            faults.add(("kernel",), f"the model gives no coordinates for {name}, so that no distance is known")


def dynamic_fields(model: ForwardModel) -> dict[str, Field]:
    """The fields of the state that are no parameters, by name."""
    constant = {p.name for p in model.parameters}
    return {f.name: f for f in model.layout if f.name not in constant}


def of_fields(kind: type[S], instead: str, make: Callable[[S, Field], T], changes: bool = False) -> Made:
    """What ``make`` makes of sections of a ``kind`` about fields of the state, in the order of the file; ``instead`` is
    what to do for a parameter. ``changes``: also about what may change unforeseen.
    """

    def read(sections: Mapping[str, Any], context: Context) -> tuple[T, ...]:
        fields = dynamic_fields(context.model)
        if changes:
            fields |= {name: Field(name) for name in context.model.unforeseen}

        def one(entry: Any, context: Context) -> T:
            return make(kind.model_validate(entry, context=context), context.subject)

        def unknown(name: str) -> str:
            if name in {p.name for p in context.model.parameters}:
                return f"{name} is a parameter: {instead}"
            return f"unknown field {shown(name)} of the state{suggest(name, fields)}"

        with Faults() as faults:
            return tuple(read_each(sections, fields, context, faults, one, unknown).values())

    return Made(read, dict[str, Any], {"type": "object", "additionalProperties": kind.model_json_schema()})


def _initial(section: InitialSpread, field: Field) -> Initial:
    std = section.std
    if section.kernel is None or section.length is None:
        return perturbation(field, std)
    return FieldPrior(field, std.value, section.kernel, section.length, std.relative, section.modes)


PERTURBED = of_fields(InitialSpread, "give it a prior in parameters", _initial)

MOST_KNOTS = 1000


class Estimated(Spread):
    """A standard deviation that is estimated, by that of its half-normal prior."""


HALF = Estimated(0.5, relative=True)


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

    def check_values(self, faults: Faults) -> None:
        at = None if self.at == "maxima" or self.at is None or None in self.at else self.at
        if at is not None and (not at or any(b <= a for a, b in itertools.pairwise(at))):
            faults.add(("at",), "give at least one knot, and each later than the one before it")

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


class VariesSection(Knots):
    """A parameter that varies in time: constant pieces, and at each knot between two a random change."""

    std: Annotated[Spread, Made(lambda t, c: HALF if t == "estimated" else parse_spread(t, subject_unit(c)))]
    """Standard deviation of each change: in % of the value (lognormal: of its logarithm), or in the parameter's
    unit, which holds at the centre of the prior; or ``estimated``, with a half-normal prior of 50 %."""

    def std_of(self, term: PriorTerm) -> float:
        """Std of each change in the prior's coordinate. Raises :class:`ConfigError`: a share of a mean that is zero."""
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


MODEL_ERROR = of_fields(ModelErrorSection, "write varies behind its prior", lambda s, f: ErrorOf(f, s), changes=True)
