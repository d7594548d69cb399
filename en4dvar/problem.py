"""What is asked of an assimilation: the inverse problem of one data set, and the settings of the scheme."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from en4dvar.forward import ForwardModel, Observable
from en4dvar.observations import Observations
from en4dvar.prior import Prior
from en4dvar.state import NOISE_SCALE, Parameter


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

    @property
    def has_noise_scale(self) -> bool:
        """Whether ``sigma`` is given and scales the observation errors (rather than being the model's own)."""
        given = NOISE_SCALE.name in self.prior.names or NOISE_SCALE.name in self.fixed
        return given and all(p.name != NOISE_SCALE.name for p in self.model.parameters)


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

    scheme: Literal["en4dvar", "es-mda", "etkf", "denkf", "enkf-n"] = "en4dvar"
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
