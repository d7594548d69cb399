r"""The mode of a changed problem, fitted from the mode of the problem itself by Gauss–Newton steps with own tangents.

The tangent at each iterate is that of central differences along half-widths of the posterior there: with A = LLᵀ the
Hessian in the coordinates of :mod:`en4dvar.diagnosis.response.linear`, the control vector moves by :data:`DIFFERENCE`
times a row of L⁻¹E, to one side where the other fails. Steps of several dampings are tried in one batch.
"""

from __future__ import annotations

import numpy as np

from en4dvar.data.noise import Linearisation
from en4dvar.data.observations import Observations
from en4dvar.diagnosis.response.linear import LinearResponse
from en4dvar.ensemble.forecast import Composite
from en4dvar.model.state import Array

MOST_STEPS = 40
SETTLED, LITTLE = 0.1, 0.05  # posterior standard deviations of a last step, and what J would fall on it
DIFFERENCE = 0.3  # posterior standard deviations
DAMPINGS = (0.0, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 1e3, 1e4)  # of the prior's precision


def refit(
    changed: Composite, observations: Observations, response: LinearResponse, std: Array, prior_shift: Array
) -> tuple[Array | None, float, int]:
    """Where the mode goes (n,), None where no minimum is reached; the cost of the readings there; forward runs.

    ``std`` (n,) of the posterior, transformed; ``prior_shift`` (n,) is the change of the prior's mean.
    """
    moved, cost, runs, linear = np.zeros(len(std)), np.nan, 0, response.linear
    for _ in range(MOST_STEPS):
        there, factor = response.at + moved, response.factor(observations, linear)
        aside = DIFFERENCE * np.linalg.solve(factor, response.directions)
        run = changed(np.vstack([there, there + aside, there - aside]))
        runs += len(run)
        central, (ahead, behind) = run[:1], (run[1 : 1 + len(aside)], run[1 + len(aside) :])
        cost = float(observations.cost(central.predicted[0])) if central.active[0] else np.nan
        if not np.isfinite(cost) or not np.all(np.logical_or(ahead.active, behind.active)):
            return None, cost, runs
        reference = central.predicted.stacked
        slopes = [sign * (part.predicted.stacked - reference) for sign, part in ((1, ahead), (-1, behind))]
        anomalies = factor @ (np.nanmean(slopes, axis=0) / DIFFERENCE)  # per unit of a coordinate
        linear = Linearisation.of_stacked(central.predicted[0], reference[0], anomalies)
        steps, decrease = response.step(observations, linear, moved, prior_shift, DAMPINGS)
        if decrease < LITTLE and np.all(np.abs(steps[0]) <= SETTLED * std):
            return moved, cost, runs
        tried = moved + steps
        trial = changed(response.at + tried)
        runs += len(trial)
        costs = np.nan_to_num(observations.cost(trial.predicted), nan=np.inf)
        totals = response.background(tried - prior_shift) + np.where(trial.active, costs, np.inf)
        best = int(np.argmin(totals))
        if not totals[best] < response.background(moved - prior_shift) + cost:
            return None, cost, runs
        moved = tried[best]
    return None, cost, runs
