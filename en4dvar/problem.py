"""What is asked of an assimilation: the inverse problem of one data set, and the settings of the scheme."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import accumulate
from typing import Annotated, Literal

from annotated_types import Ge, Gt, Le, MinLen

from en4dvar.field_prior import FieldPrior
from en4dvar.forward import Alternative, ForwardModel, Observable
from en4dvar.observations import Observations
from en4dvar.prior import Prior
from en4dvar.series import Part
from en4dvar.state import DISCREPANCY, NOISE_SCALE, READING_OFFSET, READING_SCALE, Parameter
from en4dvar.varying import PiecewiseModel, RandomWalk, Varying


@dataclass(frozen=True)
class StatePerturbation:
    """A part of the control vector that changes the initial state instead of the model's parameters.

    ``field`` of the model's layout (every component of it) is multiplied by the value where ``relative``, else the
    value is added to it.
    """

    parameter: Parameter
    field: str
    relative: bool = False


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
    times: member i is observed at t_k + t_s,i; one named ``sigma`` multiplies the std of every observation error, one
    named ``reading_scale`` the predictions, ``reading_offset`` is added to them, where the model has no parameter of
    that name. ``discrepancy_amplitude``
    and ``discrepancy_length`` are those of the discrepancy that the observations allow for. ``perturbations`` act on
    the initial state, ``tied`` follow what is estimated. ``fixed`` are physical SI values of the other parameters.
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
        ends = accumulate(one.field.size for one in self.fields)
        return [(one, slice(end - one.field.size, end)) for one, end in zip(self.fields, ends, strict=True)]

    @property
    def alternatives(self) -> tuple[Alternative, ...]:
        """Those of the model that are about the problem's observables."""
        observed = {part.observable.name for part in self.parts}
        return tuple(one for one in self.model.alternatives if not one.observable or observed == {one.observable})

    @property
    def has_noise_scale(self) -> bool:
        """Whether ``sigma`` is given and scales the observation errors (rather than being the model's own)."""
        return self._has(NOISE_SCALE)

    @property
    def has_reading_scale(self) -> bool:
        """Whether ``reading_scale`` is given and scales the predictions (rather than being the model's own)."""
        return self._has(READING_SCALE)

    @property
    def has_reading_offset(self) -> bool:
        """Whether ``reading_offset`` is given and is added to the predictions (rather than being the model's own)."""
        return self._has(READING_OFFSET)

    def _has(self, parameter: Parameter) -> bool:
        given = parameter.name in self.prior.names or parameter.name in self.fixed
        return given and all(p.name != parameter.name for p in self.model.parameters)

    @property
    def discrepancy(self) -> tuple[Parameter, ...]:
        """Amplitude and length of the model's discrepancy, in the units of the problem; () without one."""
        if not self.observations.noise.discrepant:
            return ()
        return discrepancy_parameters(self.model, self.observable)

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

    def varied(self, varying: Sequence[Varying]) -> InverseProblem:
        """The same with what varies; the changes join the control vector at its end."""
        changes = (term for one in varying for term in one.terms)
        return replace(
            self, model=PiecewiseModel(self.model, varying), prior=self.prior.of((*self.prior.terms, *changes))
        )

    @property
    def constant(self) -> InverseProblem:
        """The same with every parameter constant, and a model without error."""
        if not isinstance(self.model, PiecewiseModel):
            return self
        changes = {term.parameter.name for one in self.varying for term in one.terms}
        terms = tuple(term for term in self.prior.terms if term.parameter.name not in changes)
        return replace(self, model=self.model.model, prior=self.prior.of(terms))


def discrepancy_parameters(model: ForwardModel, observable: Observable) -> tuple[Parameter, Parameter]:
    """:data:`~en4dvar.state.DISCREPANCY` in the units of an observable and of the model's time."""
    amplitude, length = DISCREPANCY
    return (
        replace(amplitude, unit=observable.unit, display_unit=observable.display_unit),
        replace(length, unit=model.time_unit, display_unit=model.time_display_unit),
    )


Positive = Annotated[float, Gt(0)]


@dataclass(frozen=True)
class Localising:
    """How the gain of an ensemble is localised (:mod:`en4dvar.schemes.local_gain`).

    By distance with a ``radius``, in the unit of the model's coordinates, where ``at`` are the coordinates of
    parameters and of series that are no part of a field; or by correlation, ``radius`` None, with a ``threshold`` or
    its default.
    """

    radius: float | None = None
    at: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    threshold: float | None = None


@dataclass(frozen=True)
class AssimilationSettings:
    """The scheme's settings; defaults are the recommended ones.

    This is the one declaration of the keys of ``assimilation:`` in YAML: type, bounds, description and default of each.
    ``full`` takes the whole step or, where that raises J, none. The guidance of ``refine: mcmc`` uses the ``emulator``
    as well (see :mod:`en4dvar.sampling.shape`). ES-MDA reads, besides ``members``, ``sampling`` and
    ``min_active_fraction``, only ``mda_coefficients`` and ``mda_form`` (see :mod:`en4dvar.schemes.esmda`). What a
    localised scheme reads: see :mod:`en4dvar.localised`.
    """

    scheme: str = "en4dvar"  # one of those registered in en4dvar.schemes
    members: Annotated[int, Ge(3), "Ensemble size N."] = 48
    sampling: Annotated[
        Literal["exact", "random"],
        "Prior ensemble: second-order exact (mean and covariance are the prior's), or random.",
    ] = "exact"
    linearisation: Annotated[
        Literal["bundle", "transform"],
        "Tangent from runs close to the iterate (bundle), or regression over the ensemble (transform).",
    ] = "bundle"
    epsilon: Annotated[float, Gt(0), Le(1), "Size of the bundle, in prior standard deviations."] = 1e-3
    step_control: Annotated[
        Literal["line-search", "levenberg-marquardt", "full"], "What keeps J from rising along the iterations."
    ] = "line-search"
    start: Annotated[
        Literal["best-member", "prior-mean"],
        "Where the iterations start: the prior members of lowest J, or the prior mean.",
    ] = "best-member"
    starts: Annotated[
        int, Ge(1), "How many prior members of lowest J start a descent; others follow while none explains the data."
    ] = 2
    max_iterations: Annotated[int, Ge(1), "Iteration limit."] = 30
    step_tolerance: Annotated[
        float, Gt(0), "Converged where the step is shorter than this, in posterior standard deviations, √(δwᵀAδw)."
    ] = 1e-3
    cost_tolerance: Annotated[
        float, Gt(0), "Converged where J falls by less than this, relative to J (absolute below J = 1)."
    ] = 1e-4
    min_active_fraction: Annotated[
        float, Gt(0), Le(1), "Fewer surviving members than this share of the ensemble end the run (exit code 3)."
    ] = 0.5
    refine: Annotated[
        Literal["auto", "none", "mcmc"],
        "auto: sample the posterior where the ensemble leaves a doubt (cheap models); mcmc: by a Markov chain, always.",
    ] = "auto"
    draws: Annotated[
        int | None,
        Ge(400),
        "Effective draws where the posterior is sampled, whose mean is known to 1/√draws of its std; "
        "default: 1500, of a chain 1000.",
    ] = None
    emulator: Annotated[
        Literal["auto", "on", "off"],
        "A few hundred more runs to tell how Gaussian the posterior is: auto (compiled models), on, or off.",
    ] = "auto"
    what_if: Annotated[
        bool,
        "Say what the result would be under the model's alternatives, and which part of the path informed it.",
    ] = True
    stochastic_model: Annotated[
        bool,
        "true: accept a model that gives other numbers when a member is run again; by default that is an error.",
    ] = False
    mda_coefficients: Annotated[
        tuple[Positive, ...],
        MinLen(1),
        "Inflation of R in each assimilation of es-mda, scaled so that the inverses sum to one.",
    ] = (4.0, 4.0, 4.0, 4.0)
    mda_form: Annotated[
        Literal["perturbed", "square-root"], "Analysis of es-mda: perturbed observations, or a square root."
    ] = "perturbed"
    localisation: Annotated[
        Localising | None, "Which readings act on what: by distance, or by correlation; default: all on everything."
    ] = None
