r"""The linear response of a posterior: where its mode goes when predictions, observations or the prior change.

In coordinates c of the control vector, x = x̂ + Eᵀc, in which the prior's covariance is 1/(N−1), with the whitened
tangent S (K', r) at the mode x̂ of J,

    g(c) = (N−1) (c − c_b) − Sᵀ d(c),     A = (N−1) I + SᵀS,     δc = −A⁻¹ (g' − g),

g' the gradient of the changed problem and g that of the problem itself (0 at its minimum, within what the iterations
leave). With a constant R and the same prior this is δx = C JᵀR⁻¹ (δy − δm), C = EᵀA⁻¹E the covariance of the posterior.

A wrong assumption is an alternative that the model offers. Its first run, at the mode, gives the linear response.
Unless that is small anyway each further one, where it leads, corrects it with the same tangent (a chord iteration),
until what it changes is small in every parameter. An alternative that does not settle within :data:`MOST_RUNS` is
beyond linear response and is fitted again.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from en4dvar.data.noise import Linearisation, Predicted
from en4dvar.data.observations import Observations
from en4dvar.diagnosis.influence import ReadingTangent
from en4dvar.ensemble.forecast import Composite
from en4dvar.ensemble.linalg import least_coordinates
from en4dvar.executor import Executor
from en4dvar.model.forward import Alternative
from en4dvar.model.state import Array
from en4dvar.plumbing.hints import counted
from en4dvar.priors.prior import member_stream, whiten_sample
from en4dvar.problem import InverseProblem

MOST_RUNS = 6  # of one alternative
SETTLED = 0.1  # of each parameter's shift, and of its std: a correction below one of them counts as small
FAR = 3.0  # posterior standard deviations that a parameter of R may move: further away a chord seems to settle anywhere
NOWHERE = "too few members survive"
TWOFOLD = math.log(2)  # of a value that doubles or halves a factor tells more than per cent
EXCLUDED = 5.0  # standard deviations of χ² above what it is expected to be
SMALL = 0.3  # posterior standard deviations of a first step that is believed without a second


@dataclass(frozen=True)
class LinearResponse:
    """The tangent of the predictions at a control vector ``at`` (n,), and the prior about it.

    ``linear`` holds anomalies (r, K) per unit of r coordinates, ``directions`` E (r, n) the control vector's change per
    unit of each, ``precision`` is N − 1.
    """

    at: Array
    linear: Linearisation
    directions: Array
    precision: float
    observations: Observations

    @property
    def defined(self) -> bool:
        """True if the mode could be run."""
        return bool(np.isfinite(self.linear.prediction.values).all())

    @cached_property
    def whitened(self) -> tuple[Array, Array]:
        """d (K',) and S (K', r) at ``at``."""
        return self.observations.whiten(self.linear)

    @cached_property
    def gain(self) -> Array:
        """∂x̂/∂d (n, K'): how the mode follows the whitened innovation."""
        _, S = self.whitened
        return np.asarray(self.directions.T @ np.linalg.solve(self._hessian(S), S.T))

    def coordinates(self, changes: Array) -> Array:
        """Coordinates (…, r) of changes (…, n) of the control vector, of least length."""
        return least_coordinates(self.directions, changes)

    def step(
        self, observations: Observations, linear: Linearisation, moved: Array, prior_shift: Array
    ) -> tuple[Array, float]:
        """δx (n,) to the mode of a changed problem, from ``at`` + ``moved`` (n,), where ``linear`` has its prediction
        and a tangent, and by how much its J falls on the way, as far as it is quadratic.

        ``observations`` are the changed ones, ``prior_shift`` (n,) is the change of the prior's mean.
        """
        d, S = self.whitened
        changed, tangent = observations.whiten(linear)
        gradient = self.precision * self.coordinates(moved - prior_shift) - tangent.T @ changed + S.T @ d
        step = -np.linalg.solve(self._hessian(tangent), gradient)
        return np.asarray(step @ self.directions), -0.5 * float(gradient @ step)

    def tangent(self, members: Array) -> ReadingTangent:
        """Rows of each reading, of independent errors, then of what moves R, beside control vectors (N, n)."""
        d, S = self.whitened
        k = len(self.observations)
        rows = d.reshape(-1, k).T, S.reshape(-1, k, S.shape[1]).transpose(1, 0, 2)
        return ReadingTangent(*rows, self.coordinates(members - self.at), self.directions)

    def _hessian(self, S: Array) -> Array:
        return np.asarray(self.precision * np.eye(S.shape[1]) + S.T @ S)


@dataclass(frozen=True)
class Fit:
    """The mode (n,) of a problem, transformed, J there, and the forward runs it took."""

    centre: Array
    cost: float
    runs: int


Fitted = Callable[[InverseProblem], Fit | None]


@dataclass(frozen=True)
class Shift:
    """Where the posterior would go under the alternative ``name``; ``words`` complete "if …".

    ``change`` (n,) of the mode in physical SI values, ``relative`` (n,) to the mode where a parameter cannot be
    negative (else NaN), ``in_std`` (n,) in transformed space per posterior standard deviation. ``cost_change``: J there
    minus J of the fit, positive where data or prior speak against the alternative; ``misfit_change``: of its part of
    the readings. Where linear response does not tell, these are NaN and ``reason`` says why. ``runs``: forward runs it
    took.
    """

    name: str
    words: str
    change: Array
    relative: Array
    in_std: Array
    cost_change: float
    runs: int
    reason: str = ""
    misfit_change: float = math.nan

    @property
    def settled(self) -> bool:
        return not self.reason

    @property
    def largest(self) -> float:
        """The largest shift in posterior standard deviations; one that cannot be told counts as an error bar."""
        return float(np.max(np.abs(self.in_std))) if self.settled else 1.0

    @property
    def exceeds(self) -> bool:
        """True if a parameter goes, or may go, beyond its error bar."""
        return self.largest > 1 or not self.settled


def is_manifold(relative: float) -> bool:
    """True of a relative change by which a value doubles or halves at least; NaN is none."""
    return relative <= -1 or abs(math.log1p(relative)) >= TWOFOLD


def exclusion(chi2_per_reading: float, readings: int, misfit_change: float) -> str:
    """Words for an alternative with which the readings cannot be fitted, whose shifts mean nothing; "" for others. χ²
    with it is that of the fit and twice the change of the readings' part of J. Errors count as large as the fit itself
    finds them.
    """
    chi2 = chi2_per_reading * readings + 2 * misfit_change
    limit = max(1.0, chi2_per_reading) * (readings + EXCLUDED * math.sqrt(2 * readings))
    excluded = f"the readings exclude it: χ² is {chi2:.0f} for {counted(readings, 'reading')}"
    return excluded if readings and chi2 > limit else ""


def what_if(
    problem: InverseProblem, response: LinearResponse, std: Array, cost: float, executor: Executor, fitted: Fitted
) -> tuple[Shift, ...]:
    """The shifts of all alternatives of the problem's model: the largest first, then those unknown, then small ones.

    ``std`` (n,) of the posterior, transformed; ``cost`` J at ``response.at``; ``fitted`` minimises J of a problem, None
    where that fails. A scale that is estimated has an uncertainty of its own.
    """
    if not response.defined or not np.all(std > 0):
        return ()
    offered = [
        alternative
        for alternative in problem.alternatives
        if not (alternative.values != 1.0 and problem.has_reading_scale)
        and not (alternative.times != 1.0 and problem.has_time_scale)
    ]
    shifts = [_shift(problem, response, std, cost, executor, fitted, alternative) for alternative in offered]
    return tuple(sorted(shifts, key=lambda shift: -shift.largest))


def with_shifts(members: Array, shifts: Sequence[Shift], seed: int) -> Array:
    """Members (N, n) of a posterior, transformed, whose variance holds that of the assumptions as well.

    Every settled shift s_k (n,) counts as one standard deviation along its direction, as far as the data allow it:
    a member is moved by Σ_k ξ_k s_k exp(−½ max(ΔJ_k, 0)) with ξ of zero mean and unit covariance over the members that
    is uncorrelated with them (where N exceeds n and the number of shifts together), so that
    C + Σ_k s_k s_kᵀ exp(−max(ΔJ_k, 0)) is met exactly.
    """
    moved = in_std_as_likely(shifts) * members.std(axis=0, ddof=1)
    z = member_stream(seed, "what if").standard_normal((len(members), len(moved)))
    apart = len(members) > members.shape[1] + len(moved) + 1
    drawn = whiten_sample(np.hstack([members, z]))[:, members.shape[1] :] if apart else z
    return np.asarray(members + drawn @ moved)


def in_std_as_likely(shifts: Sequence[Shift]) -> Array:
    """The settled shifts (S, n) in posterior standard deviations, each times exp(−½ max(ΔJ, 0))."""
    told = [shift for shift in shifts if shift.settled]
    size = np.exp([-0.5 * max(shift.cost_change, 0.0) for shift in told])
    return np.asarray(size[:, None] * np.array([shift.in_std for shift in told])) if told else np.zeros((0, 1))


def changed_problem(problem: InverseProblem, alternative: Alternative) -> InverseProblem:
    """The problem under an alternative, but for the centres of priors; see :func:`prior_shift`."""
    o = problem.observations
    noise = o.noise.scaled(alternative.values, alternative.times)
    observations = replace(o, values=alternative.values * o.values, times=alternative.times * o.times, noise=noise)
    factors = _factors(problem, alternative)
    fixed = {name: value * factors.get(name, 1.0) for name, value in problem.fixed.items()}
    fixed |= alternative.constants
    return replace(problem, model=alternative.model or problem.model, observations=observations, fixed=fixed)


def _factors(problem: InverseProblem, alternative: Alternative) -> dict[str, float]:
    """What is known of parameters times what: a discrepancy is stated on the scales of the readings and their times."""
    scales = abs(alternative.values), abs(alternative.times)
    return dict(zip((p.name for p in problem.discrepancy), scales, strict=False)) | dict(alternative.parameters)


def prior_shift(problem: InverseProblem, factors: Sequence[tuple[str, float]]) -> Array:
    """Change (n,) of the prior's mean, transformed, when the physical value there is multiplied by ``factors``."""
    prior = problem.prior
    centre = prior.to_physical(prior.mean)
    moved = centre.copy()
    for name, factor in factors:
        if name in prior.names:
            moved[prior.names.index(name)] *= factor
    return np.asarray(prior.from_physical(moved) - prior.mean)


def _shift(
    problem: InverseProblem,
    response: LinearResponse,
    std: Array,
    cost: float,
    executor: Executor,
    fitted: Fitted,
    alternative: Alternative,
) -> Shift:
    unknown = np.full(len(std), np.nan)
    estimated = any(name in problem.prior.names for name in alternative.parameters)  # the prior says what it is
    about = alternative.name, f"the prior said that {alternative.words}" if estimated else alternative.words

    def untold(reason: str, runs: int = 0) -> Shift:
        return Shift(*about, unknown, unknown, unknown, np.nan, runs, reason)

    def background(moved: Array, of_prior: Array) -> float:
        z = problem.prior.white_change(response.at + moved - problem.prior.mean - of_prior)
        return 0.5 * float(z @ z)

    try:
        changed = changed_problem(problem, alternative)
        of_prior = prior_shift(problem, tuple(_factors(problem, alternative).items()))
        composite = Composite(changed, executor)
    except Exception as error:  # a model may offer what does not suit the problem; the reason is kept
        return untold(f"cannot be set up: {error}")
    of_errors = np.array([name in problem.of_errors for name in problem.prior.names])
    same_times = np.array_equal(problem.observations.times, changed.observations.times)
    same_run = changed.model is problem.model and same_times and changed.fixed == problem.fixed
    first = response.linear.prediction if same_run else None
    chord = _chord(composite, response, std, of_prior, of_errors, first)
    moved, runs = chord.moved, chord.runs
    if chord.failure:
        return untold(f"cannot be run: {chord.failure}", runs)
    prior = problem.prior
    if not chord.settled:
        terms = tuple(replace(t, mean=t.mean + by) for t, by in zip(prior.terms, of_prior, strict=True))
        fit = fitted(replace(changed, prior=prior.of(terms)))
        if fit is None:
            return untold(NOWHERE, runs)
        moved, there, runs = fit.centre - response.at, fit.cost, runs + fit.runs
    else:
        there = background(chord.known, of_prior) + chord.of_readings
    misfit_change = there - background(moved, of_prior) - cost + background(np.zeros(len(std)), np.zeros(len(std)))
    mode, positive = prior.to_physical(response.at), prior.bounds[0] >= 0
    change = prior.to_physical(response.at + moved) - mode
    relative = np.divide(change, mode, out=unknown.copy(), where=positive & (mode > 0))
    return Shift(*about, change, relative, moved / std, there - cost, runs, misfit_change=misfit_change)


@dataclass(frozen=True)
class _Chord:
    """Where a chord iteration led: ``moved`` (n,), its last run at ``known`` (n,), the readings' part of J at the end,
    as far as it is quadratic; ``failure`` of the run at the mode.
    """

    settled: bool
    moved: Array
    known: Array
    of_readings: float
    runs: int
    failure: str = ""


def _chord(
    changed: Composite, response: LinearResponse, std: Array, of_prior: Array, of_errors: Array, first: Predicted | None
) -> _Chord:
    """``first``: what is predicted at the mode, where that is known; ``of_errors`` (n,) tells the parameters of R."""
    moved, before, runs = np.zeros(len(std)), np.inf, 0
    observations, misfit = changed.problem.observations, np.nan
    for attempt in range(MOST_RUNS):
        predicted = None if attempt else first
        if predicted is None:
            run = changed((response.at + moved)[None])
            runs += 1
            if run.failures[0]:  # at the mode, or where linear response led
                return _Chord(False, moved, moved, misfit, runs, "" if attempt else run.failures[0])
            predicted = run.predicted[0]
        misfit = float(observations.cost(predicted))
        if not np.isfinite(misfit):  # parameters of R can be led where it cannot be factored
            break
        linear = replace(response.linear, prediction=predicted)
        step, decrease = response.step(observations, linear, moved, of_prior)
        known, moved = moved, moved + step
        if np.any(np.abs(moved / std)[of_errors] > FAR):
            break
        correction = float(np.max(np.abs(step / std)))
        small = SETTLED * np.maximum(1.0, np.abs(moved / std)) if attempt else np.full(len(std), SMALL)
        if np.all(np.abs(step / std) <= small):
            return _Chord(True, moved, known, misfit - decrease, runs)
        if correction > before:
            break
        before = correction
    return _Chord(False, moved, moved, misfit, runs)
