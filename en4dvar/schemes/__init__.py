"""Assimilation schemes: pure functions of whitened ensemble arrays.

A scheme never sees x, F, H or a truth. It says with which weights to run the members, turns their predictions into a
linearisation in weight space, and turns the whitened linearisation into a direction and a transform. The loop
(:mod:`en4dvar.assimilate`) runs the model; step control (:mod:`en4dvar.descent.step_control`) decides how far to go.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from en4dvar.ensemble.linalg import Hessian
from en4dvar.ensemble.near_prior import NearPrior
from en4dvar.state import Array


@dataclass(frozen=True)
class Weights:
    """An ensemble in weight space: centre ``w`` (N,) and transform ``T`` (N, N), rows of 1wᵀ + T are members."""

    w: Array
    T: Array
    inverse: Array | None = None  # T⁻¹, where it was at hand

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
class Evaluation:
    """What a forecast says about the centre: whitened innovation ``d`` (K',) and whitened anomalies ``S`` (K', N).

    With ``basis`` U (N, r), orthonormal columns, ``S`` (K', r) is per unit of its coordinates: the anomalies are S Uᵀ.
    ``hessian``: that of S, where it was at hand.
    """

    d: Array
    S: Array
    basis: Array | None = None
    hessian: Hessian | None = None


@dataclass(frozen=True)
class Step:
    """An undamped step in weight space and the posterior transform at the point it starts from.

    ``gradient`` g (N,) of J, ``hessian`` A, ``direction`` −A⁻¹g (N,).
    """

    gradient: Array
    hessian: Hessian
    direction: Array

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


def gauss_newton(weights: Weights, evaluation: Evaluation) -> Step:
    """The analysis that all schemes share: g = (N−1) w − Sᵀd, A = (N−1) I + SᵀS, δw = −A⁻¹g, T = √(N−1) A^{-1/2}."""
    hessian = evaluation.hessian or Hessian.of(evaluation.S, evaluation.basis)
    slope = evaluation.S.T @ evaluation.d
    gradient = hessian.prior_precision * weights.w - (slope if evaluation.basis is None else evaluation.basis @ slope)
    return Step(gradient, hessian, -hessian.solve(gradient))


@dataclass(frozen=True)
class FullStep:
    """Weights after an undamped step, T that of the point it starts from, and its length as :attr:`Step.norm`."""

    weights: Weights
    norm: float


def full_step(weights: Weights, evaluation: Evaluation, inverse: bool = False) -> FullStep:
    """:func:`gauss_newton` where nothing but the next weights is asked for, T⁻¹ or not, by the cheapest root of A."""
    hessian = NearPrior.of(evaluation.S)
    gradient = hessian.prior_precision * weights.w - evaluation.d @ evaluation.S
    ascent = hessian.solve(gradient)
    norm = math.sqrt(max(0.0, float(gradient @ ascent)))
    after = hessian.inverse_transform if inverse else None
    return FullStep(Weights(weights.w - ascent, hessian.transform, after), norm)


class Scheme(Protocol):
    """The author of a scheme writes these four."""

    def init(self, n_members: int) -> Weights:
        """Weights of the prior: w = 0, T = I."""

    def member_weights(self, weights: Weights) -> Array:
        """Weights (N, N) of the members to be run next, as rows."""

    def linearise(
        self, weights: Weights, basis: Array, predictions: Array, central: Array, active: Array
    ) -> tuple[Array, Array]:
        """Reference prediction (Ky,) and anomalies C (r, Ky) per unit of the coordinates of ``basis``.

        ``predictions`` (N, Ky) of the members of :meth:`member_weights`, ``central`` (Ky,) of the centre, ``active``
        (N,) bool; rows of failed members are not read. ``basis`` U (N, r) spans the prior anomalies
        (:func:`en4dvar.ensemble.linalg.anomaly_basis`): per unit weight the anomalies are U C.
        """

    def step(self, weights: Weights, evaluation: Evaluation) -> Step:
        """Direction and transform from the whitened linearisation at ``weights``."""
