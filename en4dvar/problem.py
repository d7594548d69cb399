"""What goes into :func:`en4dvar.assimilate.assimilate` and what comes out of it, for one data set."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

import numpy as np

from en4dvar.forward import ForwardModel, Observable, ValidityLimit
from en4dvar.observations import Observations
from en4dvar.state import Array, Parameter

if TYPE_CHECKING:
    from en4dvar.honesty import Caution
    from en4dvar.prior import Prior


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
class InverseProblem:
    """Everything that defines a posterior: F, H, y, R, the prior, and the values held fixed.

    The control vector holds ``prior.parameters`` in transformed space. A parameter named ``t_s`` shifts the observation
    times: member i is observed at t_k + t_s,i; one named ``sigma`` multiplies the std of every observation error, where
    the model has no parameter of that name. ``perturbations`` act on the initial state. ``fixed`` are physical SI
    values of the other parameters.
    """

    model: ForwardModel
    observable: Observable
    observations: Observations
    prior: Prior
    fixed: Mapping[str, float] = field(default_factory=dict)
    perturbations: tuple[StatePerturbation, ...] = ()


@dataclass(frozen=True)
class AssimilationSettings:
    """The scheme's settings; defaults are the recommended ones.

    ``step_tolerance`` is a length in posterior standard deviations, √(δwᵀAδw); ``cost_tolerance`` is relative to J,
    and absolute below J = 1. ``full`` takes the whole step or, where that raises J, none. ``starts`` prior members of
    lowest J are compared by a descent from each, then others as long as none explains the data (see
    :mod:`en4dvar.descent.start`). ``emulator`` spends a few hundred more runs on how Gaussian the posterior is, where
    the members leave it open (see :mod:`en4dvar.sampling.shape`), and on the guidance of ``refine: mcmc``; ``auto``
    does so with compiled models. ES-MDA reads, besides ``members``, ``sampling`` and ``min_active_fraction``, only
    ``mda_coefficients``, scaled so that Σ 1/α = 1, and ``mda_form`` (see :mod:`en4dvar.schemes.esmda`).
    """

    scheme: Literal["en4dvar", "es-mda"] = "en4dvar"
    members: int = 48
    sampling: Literal["exact", "random"] = "exact"
    linearisation: Literal["bundle", "transform"] = "bundle"
    epsilon: float = 1e-3
    step_control: Literal["line-search", "levenberg-marquardt", "full"] = "line-search"
    start: Literal["best-member", "prior-mean"] = "best-member"
    starts: int = 2
    max_iterations: int = 30
    step_tolerance: float = 1e-3
    cost_tolerance: float = 1e-4
    min_active_fraction: float = 0.5
    refine: Literal["none", "mcmc"] = "none"
    emulator: Literal["auto", "on", "off"] = "auto"
    mda_coefficients: tuple[float, ...] = (4.0, 4.0, 4.0, 4.0)
    mda_form: Literal["perturbed", "square-root"] = "perturbed"


@dataclass(frozen=True)
class IterationRecord:
    """Diagnostics of one iteration (glossary of the field). Parameters are physical, SI.

    ``cost = background + observation`` is J of the central trajectory at the iterate that *starts* the iteration;
    the last record is the accepted end point. ``step_norm`` is the undamped step there in posterior standard
    deviations, ``step_length`` the accepted fraction of it (0: no move). ``members`` (N, n) is the ensemble that the
    scheme's weights and transform describe at that iterate. ``active`` counts the members whose forecast
    succeeded; it is N where fewer runs gave the tangent and none failed.
    """

    iteration: int
    cost: float
    background: float
    observation: float
    step_norm: float
    step_length: float
    chi2_per_observation: float
    dfs: float
    spread: float
    active: int
    members: Array
    centre: Array


@dataclass(frozen=True)
class ChainRecord:
    """Where a Markov chain stands (``refine: mcmc``): steps so far, the largest split R-hat of any parameter, and the
    smallest effective sample size.
    """

    steps: int
    r_hat: float
    effective: float


@dataclass(frozen=True)
class StartRecord:
    """Where the descents stand that decide where the iterations start: rounds of moves, J of each descent, and how
    many are under way. The moves of the lowest become the first iterations.
    """

    rounds: int
    costs: tuple[float, ...]
    active: int


Record = IterationRecord | StartRecord | ChainRecord
Progress = Callable[[str, Record], None]  # what hears of them, with the name of the data set


@dataclass(frozen=True)
class Analysis:
    """The outcome for one data set: arrays only, members in order, physical SI values, NaN where a member failed.

    Shapes: N members, n estimated parameters, K observations, M points of the plotting grid.
    """

    name: str
    parameters: tuple[Parameter, ...]
    fixed: Mapping[str, float]
    fixed_parameters: tuple[Parameter, ...]
    observable: Observable
    observations: Observations
    time_unit: str
    time_display_unit: str
    prior: Array  # (N, n)
    posterior: Array  # (N, n)
    centre: Array  # (n,) the minimum of J
    prior_predictions: Array  # (N, K) noise-free H(F(x))
    posterior_predictions: Array  # (N, K)
    centre_predictions: Array  # (K,)
    error_std: Array  # (K,) total observation-error std at the centre, timing error included
    log_likelihood: Array  # (N, K) of the posterior members
    trajectory_times: Array  # (M,) on the clock of the observations (member i is seen at t + t_s,i)
    prior_trajectories: Array  # (N, M) observable along the path
    posterior_trajectories: Array  # (N, M)
    prior_failures: tuple[str, ...]  # (N,) reason, "" where the member is alive
    posterior_failures: tuple[str, ...]  # (N,)
    iterations: tuple[IterationRecord, ...]
    dfs_per_parameter: Array  # (n,) 1 - posterior variance / prior variance, in transformed space
    converged: bool
    stop_reason: str
    forward_runs: int
    seed: int
    settings: AssimilationSettings
    cautions: tuple[Caution, ...] = ()  # why not to trust the posterior, the worst first
    log_evidence: float = float("nan")  # ln p(y), Laplace approximation
    shape: Mapping[str, float] = field(default_factory=dict)  # how Gaussian the posterior is (en4dvar.sampling.shape)
    huber_weight: Array | None = None  # (K,) weights of the robust cost at the centre, where there is one
    refinement: Mapping[str, float] = field(default_factory=dict)  # summary of the Markov chain, if any
    limits: tuple[ValidityLimit, ...] = ()  # V of the model
    extremes: Array = field(default_factory=lambda: np.empty((0, 0)))  # (N, V) reached by the posterior members

    @property
    def warnings(self) -> tuple[str, ...]:
        """The words of the cautions."""
        return tuple(c.words for c in self.cautions)
