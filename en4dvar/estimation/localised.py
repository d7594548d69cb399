"""One data set with a localised gain: whole fields and many parameters, from their prior ensemble to the posterior.

The ensemble (N, n + m), n parameters with names in transformed space and m cells of fields, is changed in place; what
is made beside it is a few vectors, and the paths of a few members at a time (:mod:`en4dvar.descent.field`). En4D-Var
starts at the prior mean and reads ``epsilon``, ``max_iterations``, ``step_tolerance`` and ``cost_tolerance`` of the
settings, ES-MDA ``mda_coefficients``, both ``members``, ``sampling`` (``exact``: the mean is the prior's) and
``min_active_fraction``. An interrupted run begins again with this data set.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from en4dvar.data.noise import Predicted
from en4dvar.descent.field import Passes, field_en4dvar
from en4dvar.descent.field_data import FieldData, Pass, gain_of, moment_of, prior_members
from en4dvar.descent.loop import minimise
from en4dvar.descent.weight_space import require_members
from en4dvar.diagnosis import diagnostics as diag
from en4dvar.diagnosis.analysis import Analysis, FieldEstimate, IterationRecord, Progress
from en4dvar.diagnosis.honesty import ControlEnsembles, examine
from en4dvar.ensemble.forecast import NO_TIMES, Composite, Forecast, check_problem, plotting_times
from en4dvar.ensemble.members import InitialStates
from en4dvar.ensemble.missing import filled, fitted
from en4dvar.ensemble.repeat import check_forecast_repeats
from en4dvar.estimation import conclusions
from en4dvar.executor import Executor
from en4dvar.model.state import Array, Indices
from en4dvar.plumbing.errors import En4dvarError, TooFewMembersError
from en4dvar.plumbing.hints import counted
from en4dvar.priors.field_prior import FieldPrior
from en4dvar.problem import InverseProblem
from en4dvar.schemes.local_gain import ByDistance
from en4dvar.schemes.settings import AssimilationSettings

PATHS = 1 << 23  # numbers of the paths that are held at a time, unless a quarter of the ensemble has more


class Localised:
    """:meth:`run` is :func:`en4dvar.estimation.assimilate.assimilate`. Raises as that does."""

    def __init__(
        self, problem: InverseProblem, settings: AssimilationSettings, seed: int, executor: Executor,
        progress: Progress | None,
    ):  # fmt: skip
        self.fixed_parameters = check_problem(problem)
        self.gain = gain_of(problem, settings)
        self.problem, self.settings, self.seed, self.progress = problem, settings, seed, progress
        self.composite, self.grid = Composite(problem, executor), plotting_times(problem)
        self.named = n = len(problem.prior.terms)
        # each field with its columns of the ensemble
        self.fields = [(own, slice(n + of.start, n + of.stop)) for own, of in problem.columns_of_fields]
        self.ensemble = prior_members(problem, settings, seed)
        self.everyone = np.arange(settings.members)
        self.fewest = max(2, math.ceil(settings.min_active_fraction * settings.members))
        numbers = problem.model.layout.size * (len(problem.observations.instants[0]) + 2)
        self.at_once = max(1, max(PATHS, self.ensemble.size // 4) // numbers)
        self.forward_runs = 0
        self.records: list[IterationRecord] = []
        self.failures: tuple[str, ...] = ()

    def run(self) -> Analysis:
        problem, ensemble, n = self.problem, self.ensemble, self.named
        before, prior_mean = ensemble[:, :n].copy(), moment_of(ensemble, self.everyone)
        base = self._base(prior_mean[:n])
        moments = [self._moments(prior_field, columns, base) for prior_field, columns in self.fields]
        prior_run = filled(self.forecast(ensemble, self.grid), ensemble)
        require_members(problem, prior_run, self.fewest, "prior forecast")
        if not self.settings.stochastic_model:
            check_forecast_repeats(problem, prior_run, lambda some: self.forecast(ensemble[some], self.grid))
        variance = moment_of(ensemble, self.everyone, np.var)
        centre, converged, stop, lost = self._descend(prior_run)
        run = filled(self.forecast(ensemble, self.grid), ensemble)
        central = self.forecast(centre[None])
        if central.partial.any():
            both = np.vstack([centre, ensemble]), np.vstack([central.predictions, run.predictions])
            central = replace(central, predicted=Predicted(fitted(*both)[:1]), failures=("",))
        run = replace(run, failures=tuple(reason or lost[i] for i, reason in enumerate(run.failures)))
        require_members(problem, run, self.fewest, "posterior forecast")
        self._end(run, central, centre, variance)
        after = ensemble[:, :n].copy()
        fields = [
            self._field(prior_field, columns, base, centre, np.flatnonzero(run.active), *moment)
            for (prior_field, columns), moment in zip(self.fields, moments, strict=True)
        ]
        analysis = conclusions.outcome_of(
            problem, self.settings, self.seed, (before, after, centre[:n]), (prior_run, run, central),
            fixed_parameters=self.fixed_parameters,
            error_std=problem.observations.std,
            own_std=problem.observations.std,
            trajectory_times=self.grid,
            iterations=tuple(self.records),
            dfs_per_parameter=diag.dfs_per_parameter(before.var(axis=0), after[diag.active_members(run.failures)]),
            converged=converged,
            stop_reason=stop,
            forward_runs=self.forward_runs,
            fields=tuple(fields),
        )  # fmt: skip
        control = ControlEnsembles(before, after, centre[:n], None, math.nan)
        return replace(analysis, cautions=examine(analysis, control, earlier=conclusions.missing_readings(run.filled)))

    def forecast(self, x: Array, extra_times: Array = NO_TIMES) -> Forecast:
        """Of members (B, n + m), a few at a time."""
        self.forward_runs += len(x)
        firsts = range(0, len(x), self.at_once)
        return _joined([self.composite(x[i : i + self.at_once], extra_times) for i in firsts])

    def _descend(self, prior_run: Forecast) -> tuple[Array, bool, str, Sequence[str]]:
        """Ensemble → posterior; the centre, whether and why it ended, and why members (N,) were lost on the way."""
        settings, observations, ensemble = self.settings, self.problem.observations, self.ensemble
        used, weights = observations.used, observations.weights[observations.used]
        std = observations.std[used] / np.sqrt(weights)
        data = FieldData(observations.values[used], std, self._predict, self.at_once)
        lost = [""] * len(ensemble)
        try:
            if isinstance(self.gain, ByDistance) and (scheme := settings.own.minimiser):
                end = field_en4dvar(
                    ensemble,
                    data,
                    self.gain,
                    epsilon=scheme.epsilon,
                    max_iterations=scheme.max_iterations,
                    tolerance=scheme.step_tolerance,
                    cost_tolerance=scheme.cost_tolerance,
                    seed=self.seed,
                    tell=self._heard,
                )
                return end.centre, end.converged, end.stop, lost
            first = np.where(prior_run.active[:, None], prior_run.predictions[:, used], np.nan)
            inflations = settings.own.inflations
            passes = Passes(ensemble, data, self.gain, inflations, self.seed, self.fewest, first, self._heard)
            minimise(passes, [passes])
        except En4dvarError as error:
            reasons = diag.common_reasons(self.failures)
            raise TooFewMembersError(f"{observations.name}: {error}. Most frequent reasons: {reasons}") from None
        for i in set(self.everyone.tolist()) - set(passes.alive.tolist()):
            lost[i] = prior_run.failures[i] or f"failed in a pass of {settings.scheme}"
        return moment_of(ensemble, passes.alive), True, counted(len(inflations), "assimilation"), lost

    def _predict(self, members: Array) -> Array:
        run = self.forecast(members)
        self.failures = tuple(reason for reason in run.failures if reason) or self.failures
        return np.asarray(run.predictions[:, self.problem.observations.used])

    def _heard(self, at: Pass) -> None:
        """Keep the record of an iterate, and tell it."""
        observations, prior = self.problem.observations, self.problem.prior
        used = observations.used
        squares = ((observations.values[used] - at.prediction) / observations.std[used]) ** 2
        observation = 0.5 * float(observations.weights[used] @ squares)
        named = np.full((len(self.ensemble), self.named), np.nan)
        some = at.members(slice(0, self.named))
        named[: len(some)] = some
        record = IterationRecord(
            iteration=len(self.records),
            cost=at.background + observation,
            background=at.background,
            observation=observation,
            step_norm=at.step,
            step_length=at.share,
            chi2_per_observation=float(squares.mean()),
            dfs=at.dfs,
            spread=math.nan,
            active=len(some),
            members=prior.to_physical(named),
            centre=prior.to_physical(at.centre[: self.named]),
        )
        self.records.append(record)
        if self.progress is not None:
            self.progress(self.problem.observations.name, record)

    def _end(self, run: Forecast, central: Forecast, centre: Array, variance: Array) -> None:
        """The record of the end, with the spread of the posterior ensemble.

        Of es-mda the trace of H K is that of R⁻¹ H A Hᵀ, A the posterior covariance: the leverages of the readings, of
        which none exceeds 1.
        """
        observations, alive = self.problem.observations, run.active
        used = observations.used
        if not self.settings.own.minimiser:
            leverage = run.predictions[alive][:, used].var(axis=0, ddof=1) / observations.std[used] ** 2
            dfs = float(np.sum(np.minimum(observations.weights[used] * leverage, 1.0)))
            at = central.predictions[0, used]
            self._heard(Pass(centre, at, lambda part: self.ensemble[alive, part], share=0.0, dfs=dfs))
        after = moment_of(self.ensemble, np.flatnonzero(alive), np.var)
        spread = float(np.sqrt(np.mean(after / variance)))
        self.records[-1] = replace(self.records[-1], spread=spread, active=int(alive.sum()))

    def _base(self, named: Array) -> Array:
        """The model's own initial state (n_state,) at the prior mean of the parameters with names."""
        initial = InitialStates(replace(self.problem, fields=()))
        _, states, (reason,) = initial(self.problem.prior.to_physical(named)[None])
        if reason:
            raise En4dvarError(f"the model has no initial state at the prior mean: {reason}")
        return np.asarray(states[0])

    def _moments(
        self, prior_field: FieldPrior, columns: slice, base: Array, some: Indices | None = None
    ) -> tuple[Array, Array]:
        """Mean and std (size,) of the field's values over ``some`` members or all, member by member."""
        start, some = base[self.problem.model.layout[prior_field.field.name]], self.everyone if some is None else some
        mean, squares = np.zeros((2, prior_field.field.size))
        for count, i in enumerate(some, 1):
            change = prior_field.applied(start, self.ensemble[i, columns]) - mean
            mean += change / count
            squares += change**2 * ((count - 1) / count)
        return mean, np.sqrt(squares / (len(some) - 1))

    def _field(
        self, prior_field: FieldPrior, columns: slice, base: Array, centre: Array, alive: Indices, prior_mean: Array,
        prior_std: Array,
    ) -> FieldEstimate:  # fmt: skip
        """What became of it; the ensemble then holds the values themselves, of members ``alive``: a lost one stands
        where it was lost.
        """
        start = base[self.problem.model.layout[prior_field.field.name]]
        mean, std = self._moments(prior_field, columns, base, alive)
        for i, member in enumerate(self.ensemble):
            member[columns] = prior_field.applied(start, member[columns]) if i in alive else np.nan
        at_centre = prior_field.applied(start, centre[columns])
        return FieldEstimate(prior_field, self.ensemble[:, columns], at_centre, mean, std, prior_mean, prior_std)


def _joined(runs: Sequence[Forecast]) -> Forecast:
    """Runs of errors that take nothing but values from the state, one after the other."""
    if len(runs) == 1:
        return runs[0]
    return Forecast(
        Predicted(np.concatenate([run.predictions for run in runs])),
        np.concatenate([run.path for run in runs]),
        tuple(reason for run in runs for reason in run.failures),
        np.concatenate([run.extremes for run in runs]),
        np.concatenate([run.beyond for run in runs]),
    )
