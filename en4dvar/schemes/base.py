"""What a scheme is: a pure function of whitened ensemble arrays, and the keys that it reads.

A scheme never sees x, F, H or a truth. It says with which weights to run the members, turns their predictions into a
linearisation in weight space, and turns the whitened linearisation into a step. The loop (:mod:`en4dvar.descent.loop`)
runs the model, controls the step, and keeps, resumes and tells.

The weights live in the space of the prior ensemble: a member is x̄0 + X0ᵀ (w + T_i), with the ensemble weights w of the
centre and row i of the ensemble transform T.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal, Protocol, cast

import numpy as np
from annotated_types import Ge, Gt, Le

from en4dvar.ensemble.linalg import Hessian, NearPrior, centre, min_norm_fit
from en4dvar.model.state import Array


class Draw(Protocol):
    """Standard normal numbers by the name of their purpose, the same ones each time."""

    def __call__(self, purpose: str, columns: int | None = None) -> Array:
        """(N, K'), a column an observation, or (N, ``columns``) whatever the observations."""


@dataclass(frozen=True)
class Weights:
    """An ensemble in weight space: ensemble weights ``w`` (N,) and ensemble transform ``T`` (N, N).

    T of a filter may be anything that multiplies anomalies as a matrix does and has it as ``dense``. T is (0, 0) where
    members are many and the scheme does not read it. A bundle has ``wider`` times its size ε.
    """

    w: Array
    T: Array
    wider: float = 1.0

    @classmethod
    def prior(cls, n_members: int) -> "Weights":
        """w = 0, T = I."""
        return cls(np.zeros(n_members), np.eye(n_members))

    @property
    def rows(self) -> Array:
        """(N, N): member i is x̄0 + X0ᵀ rows[i]."""
        return np.asarray(self.w + self.dense)

    @property
    def dense(self) -> Array:
        """T as a matrix (N, N)."""
        transform: Any = self.T
        return np.asarray(transform if isinstance(transform, np.ndarray) else transform.dense)


@dataclass(frozen=True)
class Runs:
    """What the model says of the members of :meth:`Scheme.members`.

    ``predictions`` (M, Ky) of the members, ``central`` (Ky,) of the centre, ``active`` (M,) bool; rows of failed
    members are not read. ``basis`` U (N, r) spans the prior anomalies (:func:`en4dvar.ensemble.linalg.anomaly_basis`).
    In a series there is neither a centre nor a basis, and no member that failed.
    """

    predictions: Array
    central: Array | None = None
    active: Array | None = None
    basis: Array | None = None


@dataclass(frozen=True)
class Evaluation:
    """What the runs say about the centre: whitened innovation ``d`` (K',) and whitened anomalies ``S`` (K', N).

    With ``basis`` U (N, r), orthonormal columns, ``S`` (K', r) is per unit of its coordinates: the anomalies are S Uᵀ.
    """

    d: Array
    S: Array
    basis: Array | None = None


@dataclass(frozen=True)
class Step:
    """The weights that a scheme would take next, and how far that is in posterior standard deviations.

    ``effective``: how many members the analysis is of, where it weighs them.
    """

    weights: Weights
    norm: float
    effective: float = math.nan


@dataclass(frozen=True)
class GaussNewtonStep:
    """An undamped Gauss–Newton step from ensemble weights ``w`` (N,), and the posterior transform there.

    ``gradient`` g (N,) of J, ``hessian`` A, ``direction`` δw = −A⁻¹g (N,).
    """

    w: Array
    gradient: Array
    hessian: Hessian
    direction: Array

    @property
    def weights(self) -> Weights:
        """w + δw with the transform of the point where the step starts."""
        return Weights(self.w + self.direction, self.transform)

    @property
    def transform(self) -> Array:
        """T = √(N−1) A^{-1/2} (N, N)."""
        return self.hessian.transform

    @property
    def norm(self) -> float:
        """√(δwᵀ A δw), the Newton decrement: the length of the step in posterior standard deviations."""
        return math.sqrt(max(0.0, -float(self.gradient @ self.direction)))

    @property
    def predicted_decrease(self) -> float:
        """Decrease of the quadratic model of J over the full step, ½ norm²."""
        return 0.5 * self.norm**2


def mda_inflations(coefficients: Sequence[float]) -> Array:
    """α_a of multiple data assimilation, scaled so that Σ 1/α_a = 1."""
    alpha = np.array(coefficients)
    return np.asarray(alpha * np.sum(1 / alpha))


def regression(coordinates: Array, runs: Runs) -> tuple[Array, Array]:
    """Prediction (Ky,) at the centre and slopes (r, Ky), by regression of the survivors' on ``coordinates`` (M, r)."""
    assert runs.active is not None
    alive = coordinates[runs.active]
    fit = min_norm_fit(np.column_stack([np.ones(len(alive)), alive]), runs.predictions[runs.active] - runs.central)
    return runs.central + fit[0], fit[1:]


def gauss_newton(w: Array, evaluation: Evaluation) -> GaussNewtonStep:
    """g = (N−1) w − Sᵀd, A = (N−1) I + SᵀS, δw = −A⁻¹ g, in the coordinates of a basis where there is one."""
    basis = evaluation.basis
    # a filter asks nothing of its Hessian that NearPrior does not answer
    hessian = cast(Hessian, NearPrior.of(evaluation.S)) if basis is None else Hessian.of(evaluation.S, basis)
    slope = evaluation.d @ evaluation.S if basis is None else basis @ (evaluation.S.T @ evaluation.d)
    gradient = hessian.prior_precision * w - slope
    return GaussNewtonStep(w, gradient, hessian, -hessian.solve(gradient))


@dataclass(frozen=True)
class Scheme:
    """The author of a scheme writes a subclass; its fields are the keys of ``assimilation:`` that it reads, each with
    type, bounds, description and default. What it can do is said by the class:

    ``words``: what it is, in two or three of them. ``on``: what it can be run on, ``window`` (the data of one set, for
    parameters), ``series``, or both. ``filters``: it analyses its members once, where they stand. ``resamples``:
    members survive as a whole, so that no part of the state can be analysed by itself, and its forecast is not
    Gaussian. ``perturbs``: its transform is random, and only on average that of the posterior. ``cycled``: the next
    forecast of a series starts from the analysis; a baseline's from the forecast, as if nothing was observed.
    ``climatological``: the covariances of its analysis, where that is not localised, are averages over the forecasts of
    a series so far. ``approximate``: what it does, in words, that makes its ensemble another than the posterior even
    where model and errors are linear and Gaussian. ``localised_keys``: the fields that it reads where its gain is
    localised; None: it cannot be. ``lag``: cycles of a series that the window is long, 0 of a filter, and ``shift``: by
    which it moves on.
    """

    words: ClassVar[str] = ""
    on: ClassVar[tuple[str, ...]] = ("window",)
    filters: ClassVar[bool] = False
    resamples: ClassVar[bool] = False
    perturbs: ClassVar[bool] = False
    cycled: ClassVar[bool] = True
    climatological: ClassVar[bool] = False
    approximate: ClassVar[str] = ""
    localised_keys: ClassVar[frozenset[str] | None] = None
    lag, shift = 0, 1

    @property
    def minimiser(self) -> "Minimiser | None":
        """The scheme itself where its steps are Gauss–Newton steps of J, judged by J of the central run.

        Other schemes take their step as it is; their ensemble is run as a whole, and R is that at its mean.
        """
        return None

    @property
    def passes(self) -> int:
        """How often a scheme without a minimiser assimilates the same observations."""
        return 1

    @property
    def inflations(self) -> Array:
        """By what R is multiplied in each pass."""
        return np.ones(self.passes)

    @property
    def mda_weights(self) -> tuple[float, ...]:
        """The shares by which an observation is assimilated in one window of a series after the other."""
        return (1.0,)

    def members(self, weights: Weights, basis: Array | None = None) -> Array:
        """Weights (M, N) of the members to be run next, as rows."""
        return weights.rows

    def linearise(self, weights: Weights, runs: Runs) -> tuple[Array, Array]:
        """Reference prediction (Ky,) and anomalies (N, Ky) per unit weight, or (r, Ky) per unit of the basis."""
        return centre(runs.predictions)

    def advance(self, weights: Weights, evaluation: Evaluation, iteration: int, draw: Draw) -> Step | GaussNewtonStep:
        """The step from there; ``iteration`` counts from 0, ``draw`` gives random numbers by name."""
        return gauss_newton(weights.w, evaluation)

    def done(self, iteration: int, step: Step | GaussNewtonStep) -> bool:
        """Whether iterations end with this step, which is taken (a minimiser is not asked).

        One that is false a thousand times is an error; a key that is a larger integer, say ``max_iterations``, allows
        for more.
        """
        return iteration + 1 == self.passes

    def left(self, step: Step | GaussNewtonStep) -> float:
        """How long the step was, in posterior standard deviations, behind which a limit has ended the iterations of a
        cycle; 0 where they were done.
        """
        return 0.0


@dataclass(frozen=True)
class Minimiser(Scheme):
    """A scheme whose descents :mod:`en4dvar.descent` takes to the minimum of J, and the keys that these read."""

    linearisation: Annotated[
        Literal["auto", "tangent", "bundle", "transform"],
        "By the derivatives that a model gives (tangent), by runs close to the iterate (bundle), or by regression over "
        "the ensemble (transform); auto: transform of a stochastic_model, else tangent where the model gives "
        "derivatives, else bundle.",
    ] = "auto"
    epsilon: Annotated[float, Gt(0), Le(1), "Largest size of the bundle, in prior standard deviations."] = 1e-3
    step_control: Annotated[
        Literal["line-search", "levenberg-marquardt", "full"],
        "What keeps J from rising along the iterations; full takes the whole step or, where that raises J, none.",
    ] = "line-search"
    start: Annotated[
        Literal["best-member", "prior-mean"] | Mapping[str, float | Mapping[str, float]],
        "Where the iterations start: the prior members of lowest J, the prior mean, or values of parameters, also of "
        "each data set by name.",
    ] = "best-member"
    starts: Annotated[
        int, Ge(1), "How many prior members of lowest J start a descent; others follow while none explains the data."
    ] = 2
    lengthen: Annotated[
        int, Ge(1), "Windows, each longer than the one before, through which the start is led; for chaotic models."
    ] = 1
    max_iterations: Annotated[int, Ge(1), "Iteration limit."] = 30
    step_tolerance: Annotated[
        float, Gt(0), "Converged where the step is shorter than this, in posterior standard deviations, √(δwᵀAδw)."
    ] = 1e-3
    cost_tolerance: Annotated[
        float, Gt(0), "Converged where J falls by less than this, relative to J (absolute below J = 1)."
    ] = 1e-4

    @property
    def minimiser(self) -> "Minimiser":
        return self

    @property
    def searches(self) -> bool:
        """Whether descents from several places are compared; a start that is stated or led there is one place."""
        return self.starts > 1 and isinstance(self.start, str) and self.lengthen == 1

    @property
    def regresses(self) -> bool:
        """Whether it linearises by regression over the ensemble, at posterior spread."""
        return self.linearisation == "transform"

    def economical(self, basis: Array) -> bool:
        """Whether a linearisation takes fewer runs than members."""
        return False
