"""What is asked of an assimilation: the inverse problem of one data set."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import accumulate
from typing import Any

from en4dvar.data.observations import Observations
from en4dvar.data.series import Part
from en4dvar.model.forward import Alternative, ForwardModel, Observable
from en4dvar.model.state import DISCREPANCY, NOISE_SCALE, READING_OFFSET, READING_SCALE, TIME_SCALE, Parameter
from en4dvar.plumbing.moved import former_name
from en4dvar.priors.field_prior import FieldPrior
from en4dvar.priors.prior import Prior, PriorTerm
from en4dvar.priors.varying import PiecewiseModel, RandomWalk, Varying

AT_ONCE = "estimate all data sets with one configuration (en4dvar run FILE.yaml --data FOLDER)"  # where theirs differ


def __getattr__(name: str) -> Any:
    return former_name(__name__, name)


@dataclass(frozen=True)
class StatePerturbation:
    """A part of the control vector that changes the initial state instead of the model's parameters.

    ``field`` of the model's layout (every component of it) is multiplied by the value where ``relative``, else the
    value is added to it. With a ``pattern`` (size,), a mode of the prior ``of`` the field, that times the value is
    added, or is the logarithm of the factor.
    """

    parameter: Parameter
    field: str
    relative: bool = False
    pattern: tuple[float, ...] = ()
    of: FieldPrior | None = None


@dataclass(frozen=True)
class Tie:
    """A parameter of the model that is ``factor`` times the one named ``to``, which is estimated."""

    parameter: Parameter
    to: str
    factor: float = 1.0


@dataclass(frozen=True)
class InverseProblem:
    """Everything that defines a posterior: F, H, y, R, the prior, and the values held fixed.

    The control vector holds ``prior.parameters`` in transformed space. A parameter named ``t_s`` shifts the observation
    times: member i is observed at t_k + t_s,i. One named ``time_scale`` multiplies t_k, ``sigma`` the std of every
    observation error, ``reading_scale`` the predictions, to which ``reading_offset`` is added, where the model has no
    parameter of that name. ``discrepancy_amplitude`` and ``discrepancy_length`` are those of the discrepancy that the
    observations allow for. ``perturbations`` act on the initial state, ``tied`` follow what is estimated. ``fixed`` are
    physical SI values of the other parameters.
    ``fields`` of the initial state are estimated cell by cell: a control vector then goes on with their cells, and the
    scheme has to be localised.

    Where the observations have parts, these say what was observed, and ``observable`` is that of the first.
    """

    model: ForwardModel
    observable: Observable
    observations: Observations
    prior: Prior
    fixed: Mapping[str, float] = field(default_factory=dict)
    perturbations: tuple[StatePerturbation, ...] = ()
    tied: tuple[Tie, ...] = ()
    fields: tuple[FieldPrior, ...] = ()

    @property
    def parts(self) -> tuple[Part, ...]:
        """The series of the data set, one at least."""
        whole = Part(self.observable.name, self.observable, 0, len(self.observations))
        return self.observations.parts or (whole,)

    @property
    def columns_of_fields(self) -> list[tuple[FieldPrior, slice]]:
        """Each field with its cells among those of a control vector, counted from the first of them."""
        ends = accumulate(prior.field.size for prior in self.fields)
        return [(prior, slice(end - prior.field.size, end)) for prior, end in zip(self.fields, ends, strict=True)]

    @property
    def alternatives(self) -> tuple[Alternative, ...]:
        """Those of the model that are about the problem's observables."""
        observed = {part.observable.name for part in self.parts}
        return tuple(a for a in self.model.alternatives if not a.observable or observed == {a.observable})

    @property
    def has_noise_scale(self) -> bool:
        """Whether ``sigma`` is given and scales the observation errors (rather than being the model's own)."""
        return self._has(NOISE_SCALE)

    @property
    def has_time_scale(self) -> bool:
        """Whether ``time_scale`` is given and scales the observation times (rather than being the model's own)."""
        return self._has(TIME_SCALE)

    @property
    def has_reading_scale(self) -> bool:
        """Whether ``reading_scale`` is given and scales the predictions (rather than being the model's own)."""
        return self._has(READING_SCALE)

    @property
    def has_reading_offset(self) -> bool:
        """Whether ``reading_offset`` is given and is added to the predictions (rather than being the model's own)."""
        return self._has(READING_OFFSET)

    def _has(self, parameter: Parameter) -> bool:
        stated = parameter.name in self.prior.names or parameter.name in self.fixed
        return stated and all(p.name != parameter.name for p in self.model.parameters)

    @property
    def discrepancy(self) -> tuple[Parameter, ...]:
        """Amplitude and length of the model's discrepancy, in the units of the problem; () without one."""
        if not self.observations.noise.discrepant:
            return ()
        return discrepancy_parameters(self.model, self.observable)

    @property
    def estimates_discrepancy(self) -> bool:
        """Whether its amplitude or length is estimated."""
        return any(parameter.name in self.prior.names for parameter in self.discrepancy)

    @property
    def of_errors(self) -> frozenset[str]:
        """Names of the parameters of R: its scale, amplitude and length of a discrepancy."""
        scale = (NOISE_SCALE,) if self.has_noise_scale else ()
        return frozenset(p.name for p in (*self.discrepancy, *scale))

    @property
    def varying(self) -> tuple[Varying, ...]:
        """The parameters, and fields of the state, that vary in time."""
        return self.model.varying if isinstance(self.model, PiecewiseModel) else ()

    @property
    def walks(self) -> tuple[RandomWalk, ...]:
        """The parameters that vary in time."""
        return self.model.walks if isinstance(self.model, PiecewiseModel) else ()

    @property
    def in_question(self) -> bool:
        """Whether the data are asked if something varies: not of what the model says may change unforeseen."""
        return self.has_constant and any(change.name not in self.model.unforeseen for change in self.varying)

    @property
    def has_constant(self) -> bool:
        """Whether something varies, and more is estimated than its changes: that much the :attr:`constant` one asks."""
        return self.constant is not self and bool(self.constant.prior.terms)

    def varied(self, varying: Sequence[Varying]) -> "InverseProblem":
        """The same with what varies; the changes join the control vector at its end."""
        changes = (term for variation in varying for term in variation.terms)
        prior = self.prior.of((*self.prior.terms, *changes))
        return replace(self, model=PiecewiseModel(self.model, varying), prior=prior)

    @property
    def constant(self) -> "InverseProblem":
        """The same with every parameter constant, and a model without error."""
        if not isinstance(self.model, PiecewiseModel):
            return self
        changes = {term.parameter.name for variation in self.varying for term in variation.terms}
        terms = tuple(term for term in self.prior.terms if term.parameter.name not in changes)
        return replace(self, model=self.model.model, prior=self.prior.of(terms))


def discrepancy_parameters(model: ForwardModel, observable: Observable) -> tuple[Parameter, Parameter]:
    """:data:`~en4dvar.model.state.DISCREPANCY` in the units of an observable and of the model's time."""
    amplitude, length = DISCREPANCY
    return (
        replace(amplitude, unit=observable.unit, display_unit=observable.display_unit),
        replace(length, unit=model.time_unit, display_unit=model.time_display_unit),
    )


def common_to(problems: Sequence[InverseProblem], names: Collection[str]) -> tuple[str, ...]:
    """Parameters with one value in all data sets that estimate them, two at least: those that are declared so
    (:attr:`Parameter.common`), not of ``names``, and have the same uncorrelated prior in all.
    """
    correlated = {name for problem in problems for block in problem.prior.blocks for name in block.names}
    terms: dict[str, list[PriorTerm]] = {}
    for term in (term for problem in problems for term in problem.prior.terms):
        terms.setdefault(term.parameter.name, []).append(term)
    return tuple(
        name
        for name, (first, *others) in terms.items()
        if first.parameter.common and name not in {*names, *correlated} and others and all(o == first for o in others)
    )
