"""Conclusions from a descent and the posterior about it: minima, evidence, residuals, influence, discrepancy."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from en4dvar.data.noise import DiscrepancyNoise, Linearisation, Predicted
from en4dvar.descent.minima import Minimum, Outcome
from en4dvar.descent.weight_space import WeightSpace
from en4dvar.diagnosis import diagnostics as diag
from en4dvar.diagnosis.analysis import BEYOND_5, Analysis, Descents, FieldEstimate, Mode
from en4dvar.diagnosis.influence import Influence
from en4dvar.diagnosis.residuals import Residuals
from en4dvar.diagnosis.response.what_if import LinearResponse
from en4dvar.diagnosis.withheld import Withheld
from en4dvar.ensemble.forecast import Forecast, of_framework
from en4dvar.ensemble.linalg import min_norm_fit
from en4dvar.ensemble.members import InitialStates
from en4dvar.model.state import NOISE_SCALE, Array
from en4dvar.plumbing.caution import Caution, caution
from en4dvar.plumbing.hints import percent
from en4dvar.priors.prior import Prior
from en4dvar.problem import InverseProblem
from en4dvar.sampling.refine import Refined
from en4dvar.schemes.settings import AssimilationSettings

LEAST = 1e-9  # variance of ln σ²
RARE = 0.01  # chance of so few readings in their bands below which the estimate is not to be quoted
ODDS = 20.0  # of residuals by one explanation against another, beyond which that is told


def outcome_of(
    problem: InverseProblem, settings: AssimilationSettings, seed: int, ensembles: tuple[Array, Array, Array],
    forecasts: tuple[Forecast, Forecast, Forecast], **more: Any,
) -> Analysis:  # fmt: skip
    """The outcome of an assimilation, of its ``ensembles`` and their ``forecasts`` and what ``more`` there is to say.

    These are members (N, n) of the parameters before and after, transformed, and the centre (n,).
    """
    prior, (before, after, centre), (prior_run, run, central) = problem.prior, ensembles, forecasts
    return Analysis(
        problem=problem,
        settings=settings,
        seed=seed,
        prior=prior.to_physical(before),
        posterior=np.where(run.active[:, None], prior.to_physical(after), np.nan),
        centre=prior.to_physical(centre),
        prior_predictions=_whole_rows(prior_run.predictions),
        posterior_predictions=_whole_rows(run.predictions),
        centre_predictions=central.predictions[0],
        log_likelihood=problem.observations.log_likelihood(run.predicted),
        prior_trajectories=_whole_rows(prior_run.path),
        posterior_trajectories=_whole_rows(run.path),
        prior_failures=prior_run.failures,
        posterior_failures=run.failures,
        extremes=run.extremes,
        beyond=run.beyond,
        **more,
    )


def fields_of(
    problem: InverseProblem, before: Array, after: Array, centre: Array, active: Array
) -> tuple[FieldEstimate, ...]:
    """Fields that were told by modes, cell by cell, of members (N, n) before and after, of which ``active`` (N,) live,
    and of the ``centre`` (n,).
    """
    initial, layout = InitialStates(problem), problem.model.layout

    def states(x: Array) -> Array:
        physical, every = problem.prior.to_physical(x), np.full((len(x), layout.size), np.nan)
        alive, started, _ = initial(physical)
        every[alive] = started
        return every

    priors = {p.of.field.name: p.of for p in problem.perturbations if p.of is not None}
    each = [states(x) for x in (before, after, centre[None])] if priors else []
    estimates = []
    for name, prior in priors.items():
        a, b, (c,) = (x[:, layout[name]] for x in each)
        b = np.where(active[:, None], b, np.nan)
        moments = [moment for x in (b, a) for moment in (np.nanmean(x, axis=0), np.nanstd(x, axis=0, ddof=1))]
        estimates.append(FieldEstimate(prior, b, c, *moments))
    return tuple(estimates)


def _whole_rows(values: Array) -> Array:
    """(B, K) with nothing but NaN in the row of a member that lacks a reading, which has failed."""
    return np.where(np.isnan(values).any(axis=1, keepdims=True), np.nan, values)


def descents_of(outcome: Outcome, n_members: int) -> Descents | None:
    """Where they ended; None where there were none to compare. Starts that are no members of the prior have number -1,
    its mean, or -2, draws beyond the ensemble.
    """
    if not outcome.minima:
        return None
    ended = {member: number for number, minimum in enumerate(outcome.minima) for member in minimum.members}
    return Descents(
        members=tuple(i if i < n_members else -1 - (i > n_members) for i in outcome.tried),
        minimum=tuple(ended.get(i, -1) for i in outcome.tried),
        costs=tuple(minimum.cost for minimum in outcome.minima),
        spread=outcome.minima[0].spread,
        runs=outcome.runs,
    )


def modes_of(prior: Prior, minima: Sequence[Minimum], sampled: Refined | None) -> tuple[Mode, ...]:
    """The minima that count, with weights: by Laplace where the posterior was not sampled, else those of its draws,
    with the modes of these in which no descent ended.
    """
    if sampled is None:
        logs = np.array([m.log_evidence(prior) - minima[0].log_evidence(prior) for m in minima[1:]])
        relative = np.append(1.0, np.exp(logs))[: len(minima)]
        stds = [BEYOND_5 * np.sqrt(np.diag(m.covariance)) for m in minima]
        own = [
            (w, m.x + np.outer((-1, 0, 1), s), m.cost)
            for w, m, s in zip(relative / relative.sum(), minima, stds, strict=True)
        ]
    else:
        own = list(sampled.modes)
    ended = [(m.cost, m.descents, m.spread) for m in minima]
    ended += [(lowest, 0, 0.0) for _, _, lowest in own[len(minima) :]]
    return tuple(
        Mode(centre, q05, q95, *told, float(weight))
        for told, weight, (q05, centre, q95) in (
            (told, w, prior.to_physical(q)) for told, (w, q, _) in zip(ended, own, strict=True) if w > 0
        )
    )


def with_posterior_scale(
    space: WeightSpace, linear: Linearisation, w: Array, members: Array
) -> tuple[Linearisation, float | None]:
    """The linearisation at the end, of weights w (N,), and None; where the noise scale σ is estimated, that at the
    minimum of J given its geometric mean over the posterior ``members`` (N, n), and ν of the inverse χ² that their σ²
    has.

    At the minimum itself σ is too small, for the fit uses up degrees of freedom.
    """
    problem, prior = space.problem, space.problem.prior
    if not (problem.has_noise_scale and NOISE_SCALE.name in prior.names):
        return linear, None
    sigma = of_framework(problem, prior.to_physical(members), NOISE_SCALE, 1.0)
    logs = np.log(sigma[sigma > 0])
    prediction = replace(linear.prediction, noise_scale=np.exp(logs.mean()))
    held = replace(linear, prediction=prediction, log_scale_anomalies=None)
    d, S = problem.observations.whiten(held)
    root = math.sqrt(len(w) - 1)
    design = np.vstack([S, root * np.eye(S.shape[1])])
    step = min_norm_fit(design, np.concatenate([d, -root * space.basis.T @ w]))
    there = replace(held, prediction=replace(prediction, values=prediction.values + step @ linear.anomalies))
    variance = max(4 * float(logs.var()), LEAST)  # of ln σ², 2/ν + 2/ν² but for higher orders
    return there, (1 + math.sqrt(1 + 2 * variance)) / variance


def residuals_of(space: WeightSpace, linear: Linearisation, freedom: float | None = None) -> Residuals:
    """Residuals of a linearisation at the end, and ν as of :func:`with_posterior_scale`."""
    observations = space.problem.observations
    speed = np.abs(_rates(space.problem, linear.prediction))
    white, sensitivity = observations.whiten(linear)
    if observations.parts:
        speed = speed / observations.std
    precision = len(space.members) - 1
    # (K,) a label for each series; for each reading, where it has several places
    labels = np.arange(len(space.problem.observations))
    for part in space.problem.parts:
        if part.has_path:
            labels[part.where] = part.begin
    about = observations.used, labels, freedom, observations.weights
    return Residuals.of(white, sensitivity, precision, speed, *about)


def timing_of(problem: InverseProblem, at: Predicted) -> float:
    """Std of the times with which independent errors make the residuals :data:`ODDS` times as probable as what is
    stated does, with a discrepancy where there is one; 0 where none does. Errors of the times differ from reading to
    reading and grow with the rate, what the model misses resembles itself from one to the next. The other readings must
    rather tell of them, too, than not, without the one that tells most: it alone may be wrong.
    """
    o = problem.observations
    if o.parts or not o.noise.quadratic or len(o.used) < 2:
        return 0.0
    rates, std, values = (part[o.used] for part in (_rates(problem, at), o.noise.std, at.values))
    shares = np.append(0.0, np.geomspace(0.01, 0.5))[:, None]  # of the time between readings
    times = np.hypot(o.noise.time_std[o.used], shares * np.median(np.diff(o.times[o.used])))
    variance = 1 + (rates * times / std) ** 2
    squares = ((o.values[o.used] - values) / std) ** 2 / variance

    def costs(weights: Array) -> Array:
        """(shares, K) each reading's part."""
        scale = np.maximum(1.0, np.average(squares, axis=1, weights=weights)[:, None])  # all may err more than stated
        return np.asarray(0.5 * weights * (squares / scale + np.log(variance * scale)))

    each = costs(o.weights[o.used])
    cost = each.sum(axis=1)
    best = int(np.argmin(cost))
    most = np.arange(len(values)) == np.argmax(each[0] - each[best])
    others = costs(np.where(most, 0.0, o.weights[o.used])).sum(axis=1)
    gain = min(float(o.cost(at)), cost[0]) - cost[best]
    return float(np.median(times[best])) if gain > math.log(ODDS) and others[best] < others[0] else 0.0


def _rates(problem: InverseProblem, at: Predicted) -> Array:
    """How fast each observable changes at its readings (K,), by differences where the model does not say; zero of
    a series with several places, or fewer than two readings."""
    if at.rates is not None:
        return at.rates
    rates = np.zeros_like(at.values)
    for part in problem.parts:
        if part.has_path and part.end - part.begin > 1:
            rates[part.where] = np.gradient(at.values[part.where], problem.observations.times[part.where])
    return rates


def influence_of(
    problem: InverseProblem, run: Forecast, members: Array, response: LinearResponse, gaussian: bool
) -> Influence | None:
    """Influence of each reading on the posterior ``members`` (N, n), whose ``run`` it is; None where it cannot be told.

    ``gaussian``: they are draws of the Gaussian about the mode.
    """
    observations, prior = problem.observations, problem.prior
    conditional = observations.log_conditional(run.predicted)
    if conditional is None:
        return None
    alive = diag.active_members(run.failures) & np.isfinite(conditional).all(axis=1)
    if alive.sum() < members.shape[1] + 2:
        return None
    if gaussian and observations.noise.independent and response.defined:
        return Influence.by_tangent(prior, members[alive], response.tangent(members[alive]))
    ratios = -observations.weights * conditional[alive]
    return Influence.by_weights(prior.to_physical(members[alive]), ratios)


def future_missed(withheld: Withheld | None) -> tuple[Caution, ...]:
    """Told where the readings after the window put the estimate in doubt."""
    if withheld is None or not withheld.missed:
        return ()
    count = len(withheld.values)
    words = f"of {count} readings after the window {percent(withheld.inside)} lie in their 90 % bands"
    rare = f" (probability {withheld.chance:.1g} if it is right)" if withheld.chance < RARE else ""
    words = f"{words}: the estimate does not predict how the data continue{rare}"
    return (caution("future-missed", words, "serious" if rare else None),)


def missing_readings(share: float, chain: bool = False) -> tuple[Caution, ...]:
    """Told where a share of the members' readings is missing; ``chain``: whether a chain was asked for."""
    words = f"{100 * share:.2g} % of the members' readings in the posterior forecast are missing (NaN)"
    words += "; each is filled in by regression on the members that have it"
    words += ", and no chain (refine: mcmc) is run, for which a draw without a reading is impossible" if chain else ""
    return (caution("readings-missing", words, "serious" if chain else None),) if share else ()


def shares_of_variance(space: WeightSpace, linear: Linearisation) -> Array:
    """(n, 3) shares of errors, discrepancy and prior in each parameter's variance, transformed; rows sum to 1.

    With coordinates c of the weights, predictions C c, K = R + A and the Hessian 𝓐 = (N−1) I + SᵀS, the minimum answers
    to y − m by 𝓐⁻¹CᵀK⁻¹, so that the covariance 𝓐⁻¹ of a linear problem is the sum of three,

        𝓐⁻¹ [ CᵀK⁻¹R K⁻¹C + rows of the errors' own parameters ] 𝓐⁻¹,     𝓐⁻¹ CᵀK⁻¹A K⁻¹C 𝓐⁻¹,     (N−1) 𝓐⁻²,

    each carried to the parameters by the prior anomalies.
    """
    observations = space.problem.observations
    noise = observations.noise
    assert isinstance(noise, DiscrepancyNoise)
    _, sensitivity = observations.whiten(linear)
    precision = len(space.members) - 1
    inverse = np.linalg.inv(precision * np.eye(sensitivity.shape[1]) + sensitivity.T @ sensitivity)
    gain = observations.precision_times(linear.prediction, linear.anomalies)  # β CᵀK⁻¹
    discrepancy = gain @ noise.covariance_of_discrepancy(linear.prediction) @ gain.T / observations.weights[0]
    errors = sensitivity.T @ sensitivity - discrepancy
    to_parameters = space.anomalies.T @ space.basis @ inverse
    parts = (errors, discrepancy, precision * np.eye(len(inverse)))
    variances = np.stack([np.einsum("ij,jk,ik->i", to_parameters, part, to_parameters) for part in parts], axis=1)
    return np.asarray(variances / variances.sum(axis=1, keepdims=True))
