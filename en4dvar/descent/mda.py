"""What ES-MDA needs of a problem: its innovations and anomalies at the current ensemble, and its perturbations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from en4dvar.descent.weight_space import Local, WeightSpace
from en4dvar.likelihood import Linearisation, error_std, whiten
from en4dvar.prior import member_stream
from en4dvar.schemes import Evaluation, Weights
from en4dvar.schemes.esmda import ESMDA
from en4dvar.state import Array


def assimilate_once(space: WeightSpace, at: Local, scheme: ESMDA, assimilation: int, seed: int) -> Weights:
    """Weights after assimilation number ``assimilation`` (from 0) of the ensemble forecast in ``at``."""
    evaluation = evaluate_ensemble(space, at)
    n_members, size = len(space.members), len(evaluation.d)
    draws = np.zeros((n_members, size))
    if scheme.form == "perturbed":
        name = f"ES-MDA {assimilation}"
        draws = np.stack([member_stream(seed, name, i).standard_normal(size) for i in range(n_members)])
    updated = scheme.update(at.weights, evaluation, float(scheme.inflations[assimilation]), draws)
    # of the weights of the mean, those that move no parameter are no part of J_b
    return Weights(space.basis @ (space.basis.T @ updated.w), updated.T)


def evaluate_ensemble(space: WeightSpace, at: Local) -> Evaluation:
    """Whitened innovation (K',) of the mean prediction and whitened predictions' anomalies (K', N) of the members.

    With timing errors R is that at the mean rate. A failed member takes the prediction that the regression on the
    survivors gives it.
    """
    observations, run = space.problem.observations, at.members
    filled = _fill(space, at, run.predictions)
    mean = filled.mean(axis=0)
    if run.rates is not None:
        rate = _fill(space, at, run.rates).mean(axis=0)
        std = error_std(observations, rate)
        observations = replace(observations, std=std, time_std=np.zeros_like(std))
    return Evaluation(*whiten(observations, Linearisation(mean, filled - mean)))


def _fill(space: WeightSpace, at: Local, predictions: Array) -> Array:
    active = at.members.active
    if active.all():
        return predictions
    central = np.zeros(predictions.shape[1])
    reference, anomalies = space.scheme.linearise(at.weights, space.basis, predictions, central, active)
    return np.where(active[:, None], predictions, reference + at.weights.T @ space.basis @ anomalies)
