"""The checks: what an assimilation ended with → warnings, the worst first. Nothing is run and nothing recomputed."""

import math
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from en4dvar.diagnosis.analysis import Analysis
from en4dvar.diagnosis.diagnostics import DECISIVE, SHORT_STEP, UNSEEN, active_members
from en4dvar.diagnosis.honesty import checks
from en4dvar.diagnosis.honesty.advice import advised
from en4dvar.diagnosis.honesty.coarse import coarse
from en4dvar.diagnosis.honesty.widening import enough
from en4dvar.model.forward import ForwardModel
from en4dvar.model.state import Array, Mask
from en4dvar.plumbing.caution import Caution, caution, of_several_modes, untrusted, worst_first
from en4dvar.plumbing.hints import shown
from en4dvar.plumbing.user_code import ReturnedError, line_of, reason_of
from en4dvar.priors.prior import Prior
from en4dvar.problem import InverseProblem

COLLAPSED = 1 / 9  # of the mean of 2 (J − J_min) per parameter: a spread below a third of what J allows
NO_SPREAD = 1e-14  # of the size of values: members that agree to rounding


@dataclass(frozen=True)
class ControlEnsembles:
    """The ensembles of an analysis as control vectors, that is in transformed space, and J of the posterior.

    N members, n parameters. ``costs`` (N,) are +inf where a member failed, and None of a localised scheme, whose J is
    not that of these members; whole fields are no part of it.
    """

    prior: Array
    posterior: Array
    centre: Array
    costs: Array | None
    centre_cost: float


def examine(
    analysis: Analysis, control: ControlEnsembles, worst_loss: Sequence[str] = (), earlier: tuple[Caution, ...] = ()
) -> tuple[Caution, ...]:
    """Everything that should keep a reader from trusting the posterior, or that they should know, worst first.

    ``worst_loss`` (N,) are the reasons of failure, "" for a member alive, in the iteration that lost most; ``earlier``
    are warnings met on the way.
    """
    a, prior = analysis, analysis.problem.prior
    alive = active_members(a.posterior_failures)
    members = a.posterior[alive]
    (chi2, dfs), n_used, factor = a.fit, len(a.problem.observations.used), 1.0
    if a.residuals is not None and a.residuals.weights is not None:
        factor, degrees = a.residuals.chi2_like
        dfs = n_used - degrees
    of_events = n_used == len(a.problem.observations) and all(part.observable.event for part in a.problem.parts)
    whole = control.costs is not None  # the ensembles stand for the whole covariance
    wide = enough(prior, control.centre, control.posterior[alive]) if whole else None
    warnings = (
        *earlier,
        *a.problem.observations.doubts,
        *doubts(a.problem, a.prior, a.prior_predictions),
        *checks.down_weighted(a),
        *checks.weighted(a),
        *unfinished(a),
        *(checks.rank(prior, control.prior, control.posterior[alive]) if whole else ()),
        *(collapse(prior, control, alive) if whole and not a.refinement else ()),
        *checks.loss("prior forecast", a.prior_failures, prior, control.prior, of_events, bool(a.refinement)),
        *checks.loss("iterations", worst_loss, prior, None, of_events, bool(a.refinement)),
        *checks.loss("posterior forecast", a.posterior_failures, prior, control.posterior, of_events),
        *checks.fit(chi2 * n_used, n_used, dfs, factor),
        *_allowed(a, checks.structure(a)),
        *checks.missed(a),
        *coarse(a),
        *other_assumptions(a),
        *(checks.conflict(prior, control.centre, a.observations.noise.timed and not a.timing, wide) if whole else ()),
        *checks.at_bound(prior, control.prior, control.posterior, a.posterior_failures),
        *_allowed(a, _validity(a, alive)),
        *checks.gaussian(prior, members, a.shape, a.settings.own.approximate),
    )
    silent = {n for n in prior.names if untrusted(warnings, n) or of_several_modes(warnings, n)}
    if path := a.problem.model.path_parameters:  # what is known from elsewhere need not be informed
        silent |= {*prior.names} - {*path}
    silent |= {term.parameter.name for change in a.problem.varying for term in change.terms}  # data may say little
    modes = {p.parameter.name: p.of.field.name for p in a.problem.perturbations if p.of is not None}
    little = tuple(checks.information(prior, control.posterior[alive], a.dfs_per_parameter, silent, modes))
    silent |= {*a.problem.of_errors, *(name for finding in little for name in finding.parameters)}
    sample = prior.from_physical(a.draws) if len(a.draws) else control.posterior[alive]
    zeros = checks.limits(prior, sample, members, silent) if whole else ()
    return advised(a, worst_first((*warnings, *little, *zeros)))


def doubts(problem: InverseProblem, members: Array, predicted: Array) -> Sequence[Caution]:
    """The model's doubts about the observations, beside prior ``members`` (N, n), physical, and their predictions (N,
    K), NaN where one failed; none where all did.
    """
    y, alive = problem.observations, np.all(np.isfinite(predicted), axis=1)
    if not alive.any():
        return ()
    values = {name: np.full(alive.sum(), value) for name, value in problem.fixed.items()}
    values |= dict(zip(problem.prior.names, members[alive].T, strict=True))
    told = list[str | Caution]()
    for part in problem.parts:
        about = deepcopy((y.times[part.where], y.values[part.where], predicted[alive, part.where], values))
        told += _doubts(problem.model, part.observable.name, *about)
    return [doubt if isinstance(doubt, Caution) else caution("implausible-data", doubt) for doubt in told]


def _doubts(model: ForwardModel, *asked: Any) -> Sequence[str | Caution]:
    """Those of a model. Raises :class:`ReturnedError` where its method fails."""
    who = f"{type(model).__name__}.doubts"
    try:
        told = model.doubts(*asked)
    except BaseException as error:
        raise ReturnedError(f"{who}: {reason_of(error)}{line_of(error)}") from error
    if not (isinstance(told, tuple | list) and all(isinstance(doubt, str | Caution) for doubt in told)):
        raise ReturnedError(f"{who} returned {shown(told)}; return a list of texts, [] where there is no doubt")
    return told


def _allowed(a: Analysis, findings: checks.Findings) -> checks.Findings:
    """Findings about what the model misses; no veto of intervals where an estimated discrepancy allows for that."""
    for finding in findings:
        vetoes = a.discrepancy is not None and finding.severity == "serious"
        yield replace(finding, severity="caution") if vetoes else finding


def _validity(a: Analysis, alive: Mask) -> checks.Findings:
    """Without a linearisation every reading that counts is taken to inform."""
    limits, observations, residuals = a.problem.model.validity, a.problem.observations, a.residuals
    which, leverage = observations.used, np.ones(len(observations.used))
    if residuals is not None:
        which, leverage = residuals.which, residuals.leverage
    if limits:
        yield from checks.validity(limits, a.extremes[alive], a.beyond[alive], observations.times[which], leverage)


def other_assumptions(analysis: Analysis) -> checks.Findings:
    """An alternative with which J is lower by what chance makes of any of so many at most once in :data:`DECISIVE`:
    all have the same parameters and priors, so that J tells of their evidences.
    """
    limit = math.log(DECISIVE * max(1, len(analysis.what_if)))
    offered, estimated = {it.name: it for it in analysis.problem.alternatives}, {*analysis.problem.prior.names}
    # a shift of a prior has a check of its own
    of_model = [s for s in analysis.what_if if s.settled and not estimated & offered[s.name].parameters.keys()]
    best = min(of_model, key=lambda shift: shift.cost_change, default=None)
    if best is None or not best.cost_change < -limit:
        return
    words = f"the readings speak for another assumption: J would be lower by {-best.cost_change:.3g} if {best.words}"
    general, options = caution("other-assumption", words), offered[best.name].options
    yield replace(general, advice=f"run with {options}, and compare both (en4dvar compare)") if options else general


def unfinished(analysis: Analysis) -> checks.Findings:
    """Iterations that stopped before their own criterion; a note where the next step would have been short, or members
    were drawn from the posterior itself afterwards, and nothing where no user would see it.

    Draws and chains warn of themselves where they are too few, or find a lower J. A gradient regressed over the
    ensemble need not vanish where J is smallest, so that variant often ends like this.
    """
    step_norm = analysis.iterations[-1].step_norm  # of the next step, had there been one
    if analysis.converged or step_norm <= UNSEEN:
        return
    words = f"not converged: {analysis.stop_reason}"
    following = f"the next step would be {step_norm:.2g} posterior standard deviations"
    if analysis.refinement:
        words = f"the search for the minimum has {words}; members are drawn from the posterior itself"
        words += ", which needs no minimum"
        yield replace(caution("not-converged", words, "note"), advice="no action is needed")
    elif step_norm <= SHORT_STEP:
        yield caution("not-converged", f"{words}; {following}", "note")
    else:
        settings = analysis.settings
        by = "" if settings.own.minimiser else f" of {settings.scheme}, which does not seek the minimum of J"
        yield caution("not-converged", f"{words}{by}; {following}")


def collapse(prior: Prior, control: ControlEnsembles, alive: Mask) -> checks.Findings:
    """A spread far below what J allows: for a Gaussian posterior 2 (J − J_min) of its members is χ²_n, with mean n; of
    draws of another one it may be less.

    The lowest J met, of a member or of the centre, stands for the minimum.
    """
    assert control.costs is not None
    costs = control.costs
    alive = alive & np.isfinite(costs)
    if alive.sum() < 2:
        return
    narrow = control.posterior[alive].std(axis=0) <= NO_SPREAD * (prior.std + np.abs(control.centre))
    if narrow.any():
        names = ", ".join(name for name, no_spread in zip(prior.names, narrow, strict=True) if no_spread)
        words = f"the ensemble has collapsed: all members have the same {names}"
        yield caution("ensemble-collapse", words, parameters=tuple(names.split(", ")))
        return
    lowest = min(control.centre_cost, float(costs[alive].min()))
    allowed = float(np.mean(2 * (costs[alive] - lowest))) / len(control.centre)
    if allowed < COLLAPSED:
        words = f"its spread is about {math.sqrt(allowed):.2g} of what the data and the prior allow"
        yield caution("ensemble-collapse", f"the ensemble has collapsed: {words}")
