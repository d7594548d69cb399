"""What a scheme is: a pure function of whitened ensemble arrays.

A scheme never sees x, F, H or a truth. It says with which weights to run the members, turns their predictions into a
linearisation in weight space, and turns the whitened linearisation into a step. The loop (:mod:`en4dvar.descent.loop`)
runs the model, controls the step, and keeps, resumes and tells.

The weights live in the space of the prior ensemble: a member is x̄0 + X0ᵀ (w + T_i), with the ensemble weights w of the
centre and row i of the ensemble transform T.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol, cast

import numpy as np

from en4dvar.ensemble.linalg import Hessian
from en4dvar.ensemble.near_prior import NearPrior
from en4dvar.state import Array


class Draw(Protocol):
    """Standard normal numbers by the name of their purpose, the same ones each time."""

    def __call__(self, purpose: str, columns: int | None = None) -> Array:
        """(N, K'), a column an observation, or (N, ``columns``) whatever the observations."""


@dataclass(frozen=True)
class Weights:
    """An ensemble in weight space: ensemble weights ``w`` (N,) and ensemble transform ``T`` (N, N).

    T is (0, 0) where members are many and the scheme does not read it. A bundle has ``wider`` times its size ε.
    """

    w: Array
    T: Array
    inverse: Array | None = None  # T⁻¹, where it was at hand
    wider: float = 1.0

    @classmethod
    def prior(cls, n_members: int) -> Weights:
        """w = 0, T = I."""
        identity = np.eye(n_members)
        return cls(np.zeros(n_members), identity, identity)

    @property
    def rows(self) -> Array:
        """(N, N): member i is x̄0 + X0ᵀ rows[i]."""
        return np.asarray(self.w + self.T)


@dataclass(frozen=True)
class Runs:
    """What the model says of the members of :meth:`Scheme.members`.

    ``predictions`` (M, Ky) of the members, ``central`` (Ky,) of the centre, ``active`` (M,) bool; rows of failed
    members are not read. ``basis`` U (N, r) spans the prior anomalies
    (:func:`en4dvar.ensemble.linalg.anomaly_basis`). In a series there is neither a centre nor a basis, and no member
    that failed.
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


def gauss_newton(w: Array, evaluation: Evaluation) -> GaussNewtonStep:
    """g = (N−1) w − Sᵀd, A = (N−1) I + SᵀS, δw = −A⁻¹ g, in the coordinates of a basis where there is one."""
    basis = evaluation.basis
    # a filter asks nothing of its Hessian that NearPrior does not answer
    hessian = cast(Hessian, NearPrior.of(evaluation.S)) if basis is None else Hessian.of(evaluation.S, basis)
    slope = evaluation.d @ evaluation.S if basis is None else basis @ (evaluation.S.T @ evaluation.d)
    gradient = hessian.prior_precision * w - slope
    return GaussNewtonStep(w, gradient, hessian, -hessian.solve(gradient))


class Scheme(Protocol):
    """The author of a scheme writes these.

    ``on``: what it can be run on, ``window`` (the data of one set, for parameters), ``series``, or both.
    ``searches``: steps are Gauss–Newton steps of J, and how far to go is found by J of the central run
    (:mod:`en4dvar.descent.step_control`). Other schemes take their step as it is; their ensemble is run as a whole, and
    R is that at its mean, ``passes`` times. ``lag``: cycles of a series that the window is long; 0 is a filter.
    """

    @property
    def on(self) -> tuple[str, ...]: ...
    @property
    def searches(self) -> bool: ...
    @property
    def passes(self) -> int: ...
    @property
    def lag(self) -> int: ...

    def members(self, weights: Weights, basis: Array | None = None) -> Array:
        """Weights (M, N) of the members to be run next, as rows."""

    def linearise(self, weights: Weights, runs: Runs) -> tuple[Array, Array]:
        """Reference prediction (Ky,) and anomalies (N, Ky) per unit weight, or (r, Ky) per unit of the basis."""

    def advance(self, weights: Weights, evaluation: Evaluation, iteration: int, draw: Draw) -> Step | GaussNewtonStep:
        """The step from there; ``iteration`` counts from 0, ``draw`` gives random numbers by name."""

    def done(self, iteration: int, step: Step | GaussNewtonStep) -> bool:
        """Whether iterations end with this step, which is taken (a scheme that searches is not asked)."""


class SeriesScheme(Scheme, Protocol):
    """A scheme on a series: ``shift``, by how many cycles its window moves on, and ``mda_weights``, the shares by which
    an observation is assimilated in one window after the other. ``cycled``: the next forecast starts from the analysis;
    a baseline's from the forecast, as if nothing was observed.
    """

    @property
    def cycled(self) -> bool: ...
    @property
    def shift(self) -> int: ...
    @property
    def mda_weights(self) -> tuple[float, ...]: ...
