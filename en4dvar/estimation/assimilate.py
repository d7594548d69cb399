"""One data set from its prior ensemble to the posterior and its predictions."""

import math
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from functools import partial

import numpy as np

from en4dvar.descent.search import SAME_COST, from_draw
from en4dvar.descent.window import Descent
from en4dvar.diagnosis import diagnostics as diag
from en4dvar.diagnosis.analysis import Analysis, Discrepancy, Progress
from en4dvar.diagnosis.honesty import ControlEnsembles, examine
from en4dvar.diagnosis.response.ledger import ledger
from en4dvar.diagnosis.response.what_if import Fit, LinearResponse, Shift, what_if, with_shifts
from en4dvar.ensemble.forecast import Forecast, cost, forecast, log_posterior
from en4dvar.estimation import conclusions
from en4dvar.estimation.localised import Localised
from en4dvar.estimation.lost_frame import lost_frame
from en4dvar.estimation.stages import Sampled, Stages, control_of, values_of
from en4dvar.executor import Executor, SerialExecutor, one_blas_thread
from en4dvar.model.state import Array
from en4dvar.plumbing.caution import Caution, caution
from en4dvar.plumbing.errors import TooFewMembersError
from en4dvar.priors.varying import PiecewiseModel
from en4dvar.priors.varying.model import clock
from en4dvar.problem import InverseProblem
from en4dvar.sampling.refine import mode_cautions, that_count
from en4dvar.schemes.settings import AssimilationSettings

__all__ = ["assimilate", "cost", "forecast", "log_posterior"]

AS_GOOD = 0.5  # of J above that of the problem itself: the data allow the change as well
INTERVALS = 2.0  # between readings, by which knots are shifted
HINT, FAR = 3.0, 2.0  # ratio of evidences, and standard deviations that a parameter moves: knots that seem to be missed
_Mode = tuple[dict[str, float], float]  # physical values where J is lowest, by name, and J there


def assimilate(
    problem: InverseProblem,
    settings: AssimilationSettings,
    seed: int,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> Analysis:
    """Estimate the parameters of one data set.

    Parameters
    ----------
    seed: of every random number; the same seed gives the same bits for any executor. In a run it is
        :func:`~en4dvar.priors.prior.own_seed` of the run's seed and the data set's name.
    executor: where members run; default in this process.
    progress: called with the name of the data set and the record of each round of the start, each iteration and each
        look at the chain.

    Raises
    ------
    ConfigError: the problem is not complete. TooFewMembersError: too few members survive a forecast.
    """
    with one_blas_thread():
        if settings.localisation is not None or problem.fields:
            return Localised(problem, settings, seed, executor or SerialExecutor(), progress).run()
        return _through(Stages(problem, settings, seed, executor or SerialExecutor(), progress))


def _through(stages: Stages) -> Analysis:
    space, prior = stages.space, stages.problem.prior
    prior_run, start = stages.descend()
    outcome, ends = stages.searched(start, prior_run)
    looking, excusable = True, True
    searches = stages.minimiser is not None and stages.minimiser.searches
    scattered = searches and len(outcome.tried) > 1 and not outcome.agreed  # all that the search could do was done
    while True:
        counting = that_count(outcome.minima, prior)
        agree = len(outcome.tried) < 2 or outcome.agreed
        descents = conclusions.descents_of(outcome, len(space.members))
        if descents and looking:  # else they are those that were told
            stages.tell(descents)
        sampled = stages.sampled(outcome.descent, ends, prior_run, counting, agree, looking)
        if sampled.refined:
            lower = sampled.refined.lower
        else:  # a chain would have found what lies lower
            lower, excusable = _without_excuse(stages) if excusable else None, False
        if lower is None:
            break
        after, beside = stages.rather(from_draw(space, outcome, lower, stages.tell), outcome, ends)
        if sampled.refined is None and after is outcome:
            break
        looking, outcome, ends = after is not outcome, after, beside
    ends = sampled.ends
    space.require_members(ends.run, "posterior forecast")
    control = ControlEnsembles(
        space.members,
        ends.members,
        ends.mode,
        space.costs(ends.members, ends.run),
        float(space.costs(ends.mode[None], ends.central)[0]),
    )
    analysis = replace(
        _concluded(stages, prior_run, outcome.descent, sampled, control),
        modes=conclusions.modes_of(prior, counting, sampled.refined),
        descents=descents,
        draws=prior.to_physical(sampled.refined.draws) if sampled.refined else np.empty((0, 0)),
    )
    cautions = [*start.warnings, *(sampled.refined.warnings if sampled.refined else ())]
    if len(outcome.tried) == 1:
        cautions.append(caution("one-descent", "only one descent was made: there may be another minimum"))
    cautions += conclusions.future_missed(analysis.withheld)
    cautions += conclusions.missing_readings(ends.run.filled, stages.settings.refine == "mcmc")
    if counting:
        settled = agree or (sampled.refined is not None and not scattered)
        cautions += mode_cautions(prior, counting, analysis.modes, settled, sampled.refined)
    cautions += _missed_knots(stages, analysis)
    told = partial(examine, analysis, control, outcome.descent.worst_loss)
    doubts = told(tuple(cautions))
    lost = lost_frame(stages, analysis, ends.mode, doubts)
    analysis = replace(analysis, cautions=told((*cautions, *lost)) if lost else doubts)
    analysis = replace(analysis, forward_runs=space.forward_runs)
    if stages.settings.what_if == "added":  # last, since what is examined is the posterior of the data
        alive, posterior = ends.run.active, np.full_like(ends.members, np.nan)
        posterior[alive] = prior.to_physical(with_shifts(ends.members[alive], analysis.what_if, stages.seed))
        analysis = replace(analysis, posterior=posterior)
    return analysis


def _concluded(
    stages: Stages, prior_run: Forecast, descent: Descent, sampled: Sampled, control: ControlEnsembles
) -> Analysis:
    space, problem, ends = stages.space, stages.problem, sampled.ends
    observations, last = problem.observations, ends.central
    # ln p(y) with constant parameters, NaN where these lose the ensemble; None where nobody asks. It is that of an
    # assimilation of its own, searched and, in doubt, sampled like this one. The posterior at zero changes (Savage &
    # Dickey) would spare the runs, but extrapolates the quadratic form of J from one minimum to the other, which may
    # be far away.
    log_evidence_constant = None
    if stages.compares and problem.in_question:
        end = _alone(stages, problem.constant, stages.settings)
        log_evidence_constant = end.log_evidence if end else np.nan
    linear, central = descent.iterate.linear, last.predicted[0]
    assert linear is not None
    along, precision = space.basis.T @ space.anomalies, len(space.members) - 1.0
    response = LinearResponse(ends.mode, replace(linear, prediction=central), along, precision, observations)
    explained = observations.noise.explained(observations.values, central)
    log_evidence = sampled.refined.log_evidence - observations.log_normalisation() if sampled.refined else math.nan
    if not math.isfinite(log_evidence) and descent.at_minimum:  # there are no draws, or too few
        newton, lowest = descent.newton, descent.iterate.cost - descent.newton.predicted_decrease
        if ends.drawn:
            log_evidence = ends.drawn.log_evidence - observations.log_normalisation()
        else:  # by Laplace
            log_evidence = diag.log_evidence(lowest, newton.hessian.singular_values, len(space.members), observations)
    std = ends.members[ends.run.active].std(axis=0, ddof=1)
    shifts: tuple[Shift, ...] = ()
    judged, freedom = conclusions.with_posterior_scale(space, linear, descent.weights.w, ends.members)
    begun = space.forward_runs  # those of fits are told with the shifts
    if stages.settings.what_if:
        fitted = partial(_fitted, stages, response.at, control.centre_cost)
        shifts = what_if(problem, response, std, control.centre_cost, space.executor, fitted)
    space.forward_runs = begun + sum(shift.runs for shift in shifts)
    path = ledger(problem, response, std) if stages.settings.what_if else None
    withheld = stages.expected(ends.members)
    space.forward_runs += path.runs if path else 0
    return conclusions.outcome_of(
        problem,
        stages.settings,
        stages.seed,
        (space.members, ends.members, ends.mode),
        (prior_run[:-1], ends.run, last),
        fixed_parameters=stages.fixed_parameters,
        error_std=observations.noise.total_std(central),
        own_std=observations.noise.error_std(central),
        trajectory_times=stages.grid,
        iterations=descent.records,
        dfs_per_parameter=diag.dfs_per_parameter(space.prior_variance, ends.members[ends.run.active]),
        converged=descent.converged,
        stop_reason=descent.stop,
        forward_runs=space.forward_runs,
        shape=sampled.shape,
        down_weights=observations.noise.down_weights(observations.values, central),
        refinement=sampled.refined.summary if sampled.refined else {},
        log_evidence=log_evidence,
        log_evidence_constant=log_evidence_constant,
        residuals=conclusions.residuals_of(space, judged, freedom),
        chi2=None if freedom is None else float(observations.chi2_per_observation(judged.prediction)),
        timing=conclusions.timing_of(problem, central),
        discrepancy=explained and Discrepancy(*explained, conclusions.shares_of_variance(space, linear)),
        influence=conclusions.influence_of(problem, ends.run, ends.members, response, sampled.refined is None),
        what_if=shifts,
        withheld=withheld,
        ledger=path,
        fields=conclusions.fields_of(problem, space.members, ends.members, ends.mode, ends.run.active),
    )


def _without_excuse(stages: Stages) -> Array | None:
    """Where (n,) a search leads that holds the parameters of R at the prior's mean; None where no discrepancy is
    estimated, no other minimum is looked for or too few members survive.

    Far from a minimum a free discrepancy grows until it excuses whatever is missed, and a descent may end there.
    """
    problem, scheme = stages.problem, stages.minimiser
    searched = scheme and scheme.searches and scheme.economical(stages.space.basis)
    if not (searched and problem.estimates_discrepancy):
        return None
    held = _errors_held(stages, problem, values_of(problem.prior, problem.prior.mean), from_there=False)
    return control_of(problem.prior, held[0]) if held else None


def _fitted(stages: Stages, at: Array, cost: float, changed: InverseProblem) -> Fit | None:
    """The mode of a changed problem: where a descent from ``at`` (n,), the mode of the problem itself, leads and, where
    J there is higher than ``cost`` by more than :data:`AS_GOOD`, the lower one of that and what a search from the prior
    finds. None where too few members survive.

    Both first hold the parameters of R, since a large discrepancy would excuse whatever is missed. Where that leads
    both to one place, the second is a descent from ``at`` that holds nothing.
    """
    values, fits, begun = values_of(changed.prior, at), list[_Mode](), stages.space.forward_runs
    held: _Mode | None = None

    def descend(start: Mapping[str, float] | None) -> None:
        if end := _mode(stages, changed, start):
            fits.append(end)

    if stages.minimiser:
        held = _errors_held(stages, changed, values, from_there=True)
        descend(held[0] if held else values)
    if not fits or not fits[0][1] < cost + AS_GOOD:
        wider = _errors_held(stages, changed, values, from_there=False)
        again = held is not None and wider is not None and abs(wider[1] - held[1]) < SAME_COST
        descend(values if again else wider[0] if wider else None)
    if not fits:
        return None
    best, lowest = min(fits, key=lambda fit: fit[1])
    return Fit(control_of(changed.prior, best), lowest, stages.space.forward_runs - begun)


def _errors_held(
    stages: Stages, problem: InverseProblem, values: Mapping[str, float], from_there: bool
) -> _Mode | None:
    """Where descents lead that hold the parameters of R as in ``values``, and start there or look from the prior; None
    where there is nothing to hold or to descend in, or too few members survive.
    """
    prior, errors = problem.prior, {name: x for name, x in values.items() if name in problem.of_errors}
    others = prior.of(tuple(term for term in prior.terms if term.parameter.name not in errors))
    if not (errors and others.terms):
        return None
    held = replace(problem, prior=others, fixed={**problem.fixed, **errors})
    end = _mode(stages, held, {name: values[name] for name in others.names} if from_there else None)
    return end and ({**values, **end[0]}, end[1])


def _mode(stages: Stages, problem: InverseProblem, start: Mapping[str, float] | None) -> _Mode | None:
    """The mode of another problem, from a ``start`` or by a search, without what is after it; else :func:`_alone`."""
    problem = replace(problem, observations=replace(problem.observations, continued=None))
    settings = replace(stages.settings, refine="none", emulator="off")
    if stages.minimiser and start:
        settings = replace(settings, own=replace(stages.minimiser, start=start))
    if end := _alone(stages, problem, settings):
        return dict(zip(problem.prior.names, end.centre.tolist(), strict=True)), end.iterations[-1].cost
    return None


def _alone(stages: Stages, problem: InverseProblem, settings: AssimilationSettings) -> Analysis | None:
    """An assimilation of another problem, without what if, whose runs count; None where too few members survive."""
    other = Stages(problem, replace(settings, what_if=False), stages.seed, stages.executor, compares=False)
    end = None
    with suppress(TooFewMembersError):
        end = _through(other)
    stages.space.forward_runs += other.space.forward_runs
    return end


def _missed_knots(stages: Stages, analysis: Analysis) -> tuple[Caution, ...]:
    """A warning where the data speak for all knots earlier, or later, by :data:`INTERVALS` between readings.

    A change that lies within a piece shifts the pieces beside it by many of their standard deviations, and the linear
    response to a knot from there does not show it: each shift is fitted anew. Where it leads :data:`FAR` away, a hint
    is enough for the warning.
    """
    problem, model, prior = stages.problem, stages.problem.model, stages.problem.prior
    if not (stages.compares and stages.settings.what_if and isinstance(model, PiecewiseModel) and model.walks):
        return ()
    by = INTERVALS * float(np.median(np.diff(np.unique(problem.observations.times[problem.observations.used]))))
    here, said = prior.from_physical(analysis.survivors), []
    for shift in (-by, by):
        moved = [replace(varied, knots=tuple(t + shift for t in varied.knots)) for varied in model.varying]
        if min(varied.knots[0] for varied in moved) <= 0:
            continue
        there = _alone(stages, replace(problem, model=PiecewiseModel(model.model, moved)), stages.settings)
        if there is None:
            continue
        gain = there.log_evidence - analysis.log_evidence
        way = np.abs(prior.from_physical(there.survivors).mean(axis=0) - here.mean(axis=0)) / here.std(axis=0, ddof=1)
        if gain > math.log(diag.DECISIVE) or (gain > math.log(HINT) and np.max(way) > FAR):
            where = f"{clock(model, by)} {'earlier' if shift < 0 else 'later'} (log evidence {gain:+.1f})"
            name = prior.parameters[int(np.argmax(way))].name
            said.append((gain, f"{where}, where {name} is {np.max(way):.1f} standard deviations from here"))
    return (caution("missed-knots", f"the data speak for knots {max(said)[1]}"),) if said else ()
