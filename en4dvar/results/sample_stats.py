"""The group ``sample_stats`` of the result of one data set: what judges the fit, the members, the readings."""

from collections.abc import Callable
from typing import Any

import numpy as np

from en4dvar.diagnosis.analysis import Analysis
from en4dvar.diagnosis.diagnostics import active_members
from en4dvar.diagnosis.influence import prior_distance
from en4dvar.diagnosis.response.what_if import Shift
from en4dvar.model.state import Array
from en4dvar.priors.prior import Prior
from en4dvar.results.declared import MEMBER, NUMBER, OWN, Declared, Item, Table, UnitRule, text
from en4dvar.results.scopes import (
    CELL_TIME,
    DISCREPANT,
    DISCREPANT_FIRST,
    LEDGER,
    LIMIT,
    RESPONSE,
    SEARCHED,
    TOLD,
    WHITENED,
    of_series,
)

SCORES = np.linspace(-4.0, 4.0, 81)  # standard scores at which a prior is kept
SHARES = ("errors", "discrepancy", "prior")
EACH_UNIT = "each in the unit of its parameter"
WITHOUT = "change of the posterior mean if the reading is left out"


def _prior_values(prior: Prior) -> Array:
    """(n, scores) of the parameters, each by itself."""
    return np.reshape([term.to_physical(term.mean + term.std * SCORES) for term in prior.terms], (-1, len(SCORES)))


MEMBERS = (
    Declared("active", MEMBER, "member survived the posterior forecast",
             lambda a: active_members(a.posterior_failures)[None], needed=True),
    Declared("failure_reason", MEMBER, "reason of failure, empty where the member is alive",
             lambda a: text(a.posterior_failures)[None], needed=True),
    Declared("prior_active", MEMBER, "member survived the prior forecast",
             lambda a: active_members(a.prior_failures)[None]),
    Declared("prior_failure_reason", MEMBER, "prior: reason of failure, empty where the member is alive",
             lambda a: text(a.prior_failures)[None]),
    Declared("centre", "parameter", f"value at the minimum of J, {EACH_UNIT}", lambda a: a.centre, needed=True),
    Declared("dfs", "parameter", "degrees of freedom for signal of the parameter", lambda a: a.dfs_per_parameter,
             needed=True),
    Declared("prior_value", "parameter prior_score", f"value at which its prior has the standard score, {EACH_UNIT}",
             lambda a: _prior_values(a.problem.prior)),
    Declared("{series}_centre", "{time}", "{label}, prediction at the minimum of J",
             of_series(lambda a: a.centre_predictions), OWN, needed=True),
    Declared("{limit}_reached", MEMBER, "{label}", lambda a, i: a.extremes[None, :, i.held], LIMIT),
)  # fmt: skip


def _whitened(key: str) -> Callable[[Analysis, Item], Array]:
    """A property of the residuals; NaN where a reading does not count."""

    def of_all(a: Analysis) -> Array:
        row = np.full(len(a.observations), np.nan)
        if a.residuals is not None:
            row[a.residuals.which] = getattr(a.residuals, key)
        return row

    return of_series(of_all)


def _prior_distance(a: Analysis) -> Array:
    living = a.prior_predictions[active_members(a.prior_failures)]
    return prior_distance(a.observations.values, living, a.error_std)


def _influence(key: str) -> Callable[[Analysis, Item], Array]:
    return of_series(lambda a: getattr(a.influence, key))


READINGS = (
    Declared("{series}_whitened_residual", "{time}", "whitened residual at the minimum of J", _whitened("white"),
             when=WHITENED),
    Declared("{series}_studentised", "{time}", "whitened residual over its own expected std",
             _whitened("studentised"), when=WHITENED),
    Declared("{series}_leverage", "{time}", "share of the reading in its own prediction", _whitened("leverage"),
             when=WHITENED),
    Declared("{series}_discrepancy", "{time}", "{label}, what the model misses, at the minimum of J",
             of_series(lambda a: a.discrepancy.mean), OWN, DISCREPANT_FIRST),
    Declared("{series}_discrepancy_std", "{time}", "{label}, std of what the model misses",
             of_series(lambda a: a.discrepancy.std), OWN, DISCREPANT_FIRST),
    *(
        Declared(f"variance_from_{source}", "parameter",
                 f"share of the posterior variance that comes from the {source}",
                 lambda a, k=k: a.discrepancy.shares[:, k], when=DISCREPANT)
        for k, source in enumerate(SHARES)
    ),
    Declared("{series}_prior_distance", "{time}",
             "distance of the reading from the prior's prediction, in the std of both", of_series(_prior_distance)),
    Declared("{shared}influence_change", "parameter {time}", f"{WITHOUT}, {EACH_UNIT}", _influence("change"),
             when=TOLD),
    Declared("{shared}influence_in_std", "parameter {time}", f"{WITHOUT}, in posterior standard deviations",
             _influence("in_std"), when=TOLD),
    Declared("{shared}influence_pareto_shape", "{time}", "Pareto shape of the weights", _influence("pareto_shape"),
             when=TOLD),
    Declared("{shared}influence_how", "{time}",
             "0: found by weighting the members, 1: by linear response, 2: needs a fit without the reading",
             of_series(lambda a: a.influence.how.astype(float)), when=TOLD),
)  # fmt: skip


def _of_modes(name: str, dims: str, key: str, meaning: str) -> Declared:
    return Declared(name, dims, meaning, lambda a: np.array([getattr(m, key) for m in a.modes]), when=SEARCHED)


MODES = (
    _of_modes("mode_centre", "mode parameter", "centre", f"minimum of J, {EACH_UNIT}"),
    _of_modes("mode_cost", "mode", "cost", "J at the minimum"),
    _of_modes("mode_weight", "mode", "weight", "probability of the mode"),
    _of_modes("mode_descents", "mode", "descents", "descents that ended there"),
    _of_modes("mode_cost_spread", "mode", "spread", "by how much J of these differs"),
    Declared("descent_member", "descent",
             "member of the prior ensemble from which it started, -1: the mean, -2: a draw beyond it",
             lambda a: np.array(a.descents.members), when=SEARCHED, fill=False),
    Declared("descent_minimum", "descent", "number of the minimum of J in which it ended, 0: the lowest, -1: none",
             lambda a: np.array(a.descents.minimum), when=SEARCHED, fill=False),
    Declared("descent_cost", "descent", "J at that minimum",
             lambda a: [a.descents.costs[k] if k >= 0 else np.nan for k in a.descents.minimum], when=SEARCHED),
)  # fmt: skip


def shifts(a: Analysis) -> list[Shift]:
    """Shifts in the order in which the model offers alternatives, so that the files of a campaign agree."""
    names = [alternative.name for alternative in a.problem.model.alternatives]
    return sorted(a.what_if, key=lambda shift: names.index(shift.name))


def _what_if(name: str, dims: str, key: str, meaning: str) -> Declared:
    def values(a: Analysis) -> Any:
        held = [getattr(shift, key) for shift in shifts(a)]
        return text(held) if isinstance(held[0], str) else np.array(held)

    return Declared(name, dims, meaning, values, when=RESPONSE)


WHAT_IF = (
    _what_if("what_if_words", "alternative", "words", "if …"),
    _what_if("what_if_change", "alternative parameter", "change",
             f"change of the centre under the alternative, {EACH_UNIT}"),
    _what_if("what_if_relative_change", "alternative parameter", "relative", "the same relative to the centre"),
    _what_if("what_if_change_in_std", "alternative parameter", "in_std", "the same in posterior standard deviations"),
    _what_if("what_if_cost_change", "alternative", "cost_change", "change of J"),
    _what_if("what_if_runs_each", "alternative", "runs", "forward runs it took"),
    _what_if("what_if_reason", "alternative", "reason", "why it cannot be told"),
)  # fmt: skip


def _ledger(name: str, dims: str, meaning: str, values: Callable[..., Any], unit: UnitRule = NUMBER) -> Declared:
    return Declared(name, dims, meaning, values, unit, LEDGER)


LEDGERS = (
    _ledger("ledger_time", "path_cell path_edge", "begin and end of the cell",
            lambda a: np.column_stack([a.ledger.edges[:-1], a.ledger.edges[1:]]), CELL_TIME),
    _ledger("ledger_weight", "path_parameter path_cell", "share of the cell in what informed the parameter",
            lambda a: a.ledger.weights),
    _ledger("ledger_kernel", "path_parameter path_cell", "averaging kernel of the estimate over the cell",
            lambda a: a.ledger.kernel),
    _ledger("ledger_{quantity}", "path_cell", "{label}, mean size in the cell", lambda a, i: a.ledger.values[i.held],
            OWN),
    _ledger("ledger_{quantity}_quantiles", "path_parameter quantile", "{label}",
            lambda a, i: a.ledger.quantiles[:, i.held], OWN),
)  # fmt: skip

SAMPLE_STATS: Table = (*MEMBERS, *READINGS, *MODES, *WHAT_IF, *LEDGERS)
