"""The variables of the result of one data set, declared once, group by group.

A data set of one observable has the dimension ``time``, and its weights are ``weights``. Of several series each has a
dimension of its own, ``<name>_time``, and ``<name>_weights``. Every value is SI; members are draws of one chain, in
order. Whatever a report needs is stored, so that nothing downstream computes it again.
"""

from collections.abc import Callable, Iterable, Iterator
from types import SimpleNamespace
from typing import Any
from unicodedata import is_normalized, normalize

import numpy as np
import numpy.typing as npt

from en4dvar.data.noise import DECAY, SHARED, SIDES
from en4dvar.diagnosis.analysis import Analysis
from en4dvar.diagnosis.diagnostics import active_members
from en4dvar.diagnosis.influence import prior_distance
from en4dvar.diagnosis.response.ledger import QUANTILES
from en4dvar.diagnosis.response.what_if import Shift
from en4dvar.model.state import Array
from en4dvar.plumbing.errors import ConfigError
from en4dvar.problem import InverseProblem
from en4dvar.results.declared import MEMBER, OWN, Declared, Item, Table, UnitRule, When, axes_of, shown_as, text

SCORES = np.linspace(-4.0, 4.0, 81)  # standard scores at which a prior is kept
SHARES = ("errors", "discrepancy", "prior")
EACH_UNIT = "each in the unit of its parameter"
WITHOUT = "change of the posterior mean if the reading is left out"

# What the placeholders of names stand for, units and conditions


def _item(placeholder: str, held: Any, of: Any, **more: Any) -> Item:
    """Of something that has a name, a label and a unit."""
    return Item(held, {placeholder: of.name}, of.label, {**shown_as(of), **more})


def _series(a: Analysis) -> Iterator[Item]:
    parts = a.problem.parts
    for axis, part in zip(axes_of([part.name for part in parts]), parts, strict=True):
        o, names = part.observable, {"series": part.name, "shared": axis.own(""), "time": axis.time}
        yield Item(part, names, o.label, shown_as(o))


def _matrices(a: Analysis) -> Iterator[Item]:
    several = bool(a.observations.parts)
    own = "reading" if several else "time"
    for key, (matrix, words) in a.observations.noise.matrices().items():
        name = key if several else f"{a.problem.observable.name}_{key}"
        dims = {SHARED: f"{own} shared_error", SIDES: own, DECAY: own}.get(key, "correlated_pair")
        dims = f"{own} {own}_column" if matrix.ndim == 2 and key != SHARED else dims
        yield Item(matrix, {"matrix": name, "pairs": dims}, words)


def _fixed(a: Analysis) -> Iterator[Item]:
    known = {p.name: p for p in a.fixed_parameters}
    for name, value in a.problem.fixed.items():
        p = known.get(name)
        about = {**shown_as(p), "source": p.source} if p else {"units": "1", "symbol": name}
        yield Item(value, {"fixed": name}, p.label if p else "fixed value", about)


SCOPES: dict[str, Callable[[Any], Iterable[Item]]] = {
    **dict.fromkeys(("series", "shared", "time"), _series),
    "parameter": lambda a: (_item("parameter", k, p, source=p.source) for k, p in enumerate(a.parameters)),
    "walk": lambda a: (Item(w, {"walk": w.name}, w.label, shown_as(w.parameter)) for w in a.problem.walks),
    "matrix": _matrices,
    "fixed": _fixed,
    "limit": lambda a: (
        Item(k, {"limit": v.name}, v.label, {"units": v.unit, "limit": v.value, "source": v.source})
        for k, v in enumerate(a.problem.model.validity)
    ),
    "quantity": lambda a: (_item("quantity", k, q) for k, q in enumerate(a.ledger.quantities if a.ledger else ())),
    "field": lambda a: (_item("field", estimate, estimate.prior.field) for estimate in a.fields),
}


def _clock(**more: str) -> UnitRule:
    """Times of the model; ``more`` attributes."""

    def attributes(a: Analysis, _: Item) -> dict[str, str]:
        return {"units": a.problem.model.time_unit, "display_units": a.problem.model.time_display_unit, **more}

    return UnitRule("time of the model", attributes, ("units", "display_units"))


TIME, CELL_TIME, PIECE_TIME = _clock(axis="T"), _clock(), _clock(axis="T", symbol="t")


def _of_data(a: Analysis, item: Item) -> dict[str, Any]:
    """Times of readings, with what the clock of the data shows at the model's time zero where that is not zero."""
    y = a.observations
    zero = float(np.broadcast_to(y.zero, len(y))[item.held.begin if item.held else 0])
    return {**TIME.attributes(a, item), **({"time_zero": zero} if zero else {})}


READ_TIME = UnitRule(f"{TIME.words}, at whose zero the clock of the data shows `time_zero`", _of_data, TIME.keys)
FIXED = UnitRule("its own", lambda _, item: item.about, ("units", "symbol"))
LIMIT = UnitRule("its own", lambda _, item: item.about)
PLACE = UnitRule("of the field's coordinates", lambda _, item: {"units": item.held.places.unit})
AT = UnitRule("of the field's coordinates", lambda _, item: {"units": item.held.prior.field.coordinate_unit})

PATH = When("one value at a time", lambda _, item: item.held.has_path)
PLACED = When("readings of a field", lambda _, item: item.held.places is not None)
ROBUST = When("robust cost", lambda a, _: a.down_weights is not None)
WHITENED = When("residuals that can be whitened", lambda a, _: a.residuals is not None)
TOLD = When("it can be told", lambda a, _: a.influence is not None)
DISCREPANT = When("a discrepancy is allowed for", lambda a, _: a.discrepancy is not None)
DISCREPANT_FIRST = When(DISCREPANT.words, lambda a, item: a.discrepancy is not None and item.held.begin == 0)
SEARCHED = When("a scheme that searches", lambda a, _: bool(a.modes) and a.descents is not None)
RESPONSE = When("a model with alternatives", lambda a, _: bool(a.what_if))
WITHHELD = When("readings after the window", lambda a, _: a.withheld is not None)
SAMPLED = When("a posterior that was sampled by weighted draws", lambda a, _: a.draws.size > 0)
LEDGER = When("a model with quantities of its path", lambda a, _: a.ledger is not None)


def of_series(values: Callable[[Any], Any]) -> Callable[[Analysis, Item], Array]:
    """The part of a series of numbers (…, K) of all readings."""
    return lambda a, item: np.asarray(values(a))[..., item.held.where]


# Members, predictions, readings, iterations


def _parameters(members: Callable[[Analysis], Array]) -> Table:
    return (
        Declared("{parameter}", MEMBER, "{label}", lambda a, i: members(a)[None, :, i.held], OWN, needed=True),
        Declared("{walk}_pieces", f"{MEMBER} {{walk}}_piece", "{label}, over the pieces of time",
                 lambda a, i: a.pieces(i.held, members(a))[None], OWN),
    )  # fmt: skip


def _predictive(members: Callable[[Analysis], Array]) -> Table:
    return (
        Declared("{series}", f"{MEMBER} {{time}}", "{label}, noise-free prediction at the observations",
                 of_series(lambda a: members(a)[None]), OWN, needed=True),
    )  # fmt: skip


def _paths(members: Callable[[Analysis], Array]) -> Table:
    """Paths of members; those of several series stand side by side."""

    def path(a: Analysis, item: Item) -> Array | npt.NDArray[np.float32]:
        width = len(a.trajectory_times)
        place = [part.name for part in a.problem.parts if part.has_path].index(item.held.name)
        curves = members(a)[None, :, place * width : (place + 1) * width]
        with np.errstate(over="ignore", under="ignore"):
            single = curves.astype(np.float32)  # unless that cannot hold a value: curves are most of what a result is
        return single if np.allclose(single, curves, rtol=1e-6, atol=0.0, equal_nan=True) else curves

    dims = f"{MEMBER} path_time"
    return (Declared("{series}_path", dims, "{label}, noise-free prediction along the path", path, OWN, PATH),)


OBSERVED = (
    Declared("{series}", "{time}", "{label}, observed", of_series(lambda a: a.observations.values), OWN, needed=True),
)
ERRORS = (
    Declared("{series}_std", "{time}", "{label}, observation-error std, timing error included",
             of_series(lambda a: a.error_std), OWN, needed=True),
    Declared("{series}_reading_std", "{time}", "{label}, observation-error std of the reading alone",
             of_series(lambda a: a.observations.std), OWN, needed=True),
    Declared("{shared}time_std", "{time}", "std of the observation times",
             of_series(lambda a: a.observations.noise.time_std), TIME, needed=True, fill=False),
    Declared("{shared}weights", "{time}", "weight of the observation in the cost",
             of_series(lambda a: a.observations.weights), needed=True),
    Declared("{series}_place", "{time}", "where on the field it was read",
             lambda _, i: i.held.places.positions, PLACE, PLACED),
    Declared("{series}_place_index", "{time} {series}_corner", "components of the field that make up the reading",
             lambda _, i: i.held.places.indices.astype(float), when=PLACED),
    Declared("{series}_place_share", "{time} {series}_corner", "their shares",
             lambda _, i: i.held.places.shares, when=PLACED),
    Declared("{series}_huber_weight", "{time}", "weight of the observation in the robust cost at its minimum",
             of_series(lambda a: a.down_weights), when=ROBUST),
    Declared("{matrix}", "{pairs}", "{label}", lambda _, i: i.held),
)  # fmt: skip
CONSTANTS = (Declared("{fixed}", "", "{label}", lambda _, i: i.held, FIXED),)
LOG_LIKELIHOOD = (
    Declared("{series}", f"{MEMBER} {{time}}", "{label}, log-likelihood of each observation",
             of_series(lambda a: a.log_likelihood[None]), needed=True),
)  # fmt: skip


def _iteration(name: str, key: str, meaning: str) -> Declared:
    return Declared(name, "iteration", meaning, lambda a: [getattr(r, key) for r in a.iterations], needed=True)


ITERATIONS = (
    _iteration("J", "cost", "cost J"),
    _iteration("J_background", "background", "background term of J"),
    _iteration("J_observation", "observation", "observation term of J"),
    _iteration("step_norm", "step_norm", "norm of the step in weights"),
    _iteration("step_length", "step_length", "fraction of the step taken"),
    _iteration("chi2_per_observation", "chi2_per_observation", "chi-squared per observation"),
    _iteration("dfs", "dfs", "degrees of freedom for signal"),
    _iteration("spread", "spread", "ensemble spread"),
    _iteration("active", "active", "members that ran"),
    Declared("{parameter}", "iteration draw", "{label}",
             lambda a, i: np.stack([r.members[:, i.held] for r in a.iterations]), OWN, needed=True),
    Declared("{parameter}_centre", "iteration", "{label}, centre",
             lambda a, i: [r.centre[i.held] for r in a.iterations], OWN, needed=True),
)  # fmt: skip


CELL = "{field}_cell"
FIELDS = (
    Declared("{field}", f"draw {CELL}", "{label}, posterior members", lambda _, i: i.held.members, OWN, single=True),
    Declared("{field}_mean", CELL, "{label}, posterior mean", lambda _, i: i.held.mean, OWN),
    Declared("{field}_std", CELL, "{label}, posterior standard deviation", lambda _, i: i.held.std, OWN),
    Declared("{field}_centre", CELL, "{label}, value at the minimum of J", lambda _, i: i.held.centre, OWN),
    Declared("{field}_prior_mean", CELL, "{label}, prior mean", lambda _, i: i.held.prior_mean, OWN),
    Declared("{field}_prior_std", CELL, "{label}, prior standard deviation", lambda _, i: i.held.prior_std, OWN),
    Declared("{field}_at", f"{CELL} {{field}}_axis", "where the cells are", lambda _, i: i.held.prior.places, AT),
)


DRAWS = (
    Declared("{parameter}", "posterior_draw", "{label}, equally likely draws beside the members",
             lambda a, i: a.draws[:, i.held], OWN, SAMPLED),
)  # fmt: skip


LATER = "withheld_time"
WITHHELD_READINGS = (
    Declared("{series}", LATER, "{label}, read after the window", lambda a, _: a.withheld.values, OWN, WITHHELD),
    Declared("{series}_low", LATER, "{label}, 5 % of what was expected", lambda a, _: a.withheld.low, OWN, WITHHELD),
    Declared("{series}_median", LATER, "{label}, median of what was expected",
             lambda a, _: a.withheld.median, OWN, WITHHELD),
    Declared("{series}_high", LATER, "{label}, 95 % of what was expected", lambda a, _: a.withheld.high, OWN, WITHHELD),
    Declared("{series}_reading_std", LATER, "{label}, observation-error std of the reading alone",
             lambda a, _: a.observations.continued.noise.std[len(a.observations) :], OWN, WITHHELD),
    Declared("time_std", LATER, "std of the observation times",
             lambda a: a.observations.continued.noise.time_std[len(a.observations) :], TIME, WITHHELD, fill=False),
)  # fmt: skip


# What judges the fit, the members, the readings: the group ``sample_stats``


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
             lambda a: np.reshape([term.to_physical(term.mean + term.std * SCORES) for term in a.problem.prior.terms],
                                  (-1, len(SCORES)))),
    Declared("{series}_centre", "{time}", "{label}, prediction at the minimum of J",
             of_series(lambda a: a.centre_predictions), OWN, needed=True),
    Declared("{limit}_reached", MEMBER, "{label}", lambda a, i: a.extremes[None, :, i.held], LIMIT),
)  # fmt: skip


def _of_residuals(a: Analysis, key: str) -> Array:
    """A property of theirs; NaN where a reading does not count."""
    row = np.full(len(a.observations), np.nan)
    if a.residuals is not None:
        row[a.residuals.which] = getattr(a.residuals, key)
    return row


READINGS = (
    Declared("{series}_whitened_residual", "{time}", "whitened residual at the minimum of J",
             of_series(lambda a: _of_residuals(a, "white")), when=WHITENED),
    Declared("{series}_studentised", "{time}", "whitened residual over its own expected std",
             of_series(lambda a: _of_residuals(a, "studentised")), when=WHITENED),
    Declared("{series}_leverage", "{time}", "share of the reading in its own prediction",
             of_series(lambda a: _of_residuals(a, "leverage")), when=WHITENED),
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
             "distance of the reading from the prior's prediction, in the std of both",
             of_series(lambda a: prior_distance(
                 a.observations.values, a.prior_predictions[active_members(a.prior_failures)], a.error_std))),
    Declared("{shared}influence_change", "parameter {time}", f"{WITHOUT}, {EACH_UNIT}",
             of_series(lambda a: a.influence.change), when=TOLD),
    Declared("{shared}influence_in_std", "parameter {time}", f"{WITHOUT}, in posterior standard deviations",
             of_series(lambda a: a.influence.in_std), when=TOLD),
    Declared("{shared}influence_pareto_shape", "{time}", "Pareto shape of the weights",
             of_series(lambda a: a.influence.pareto_shape), when=TOLD),
    Declared("{shared}influence_how", "{time}",
             "0: found by weighting the members, 1: by linear response, 2: needs a fit without the reading",
             of_series(lambda a: a.influence.how.astype(float)), when=TOLD),
)  # fmt: skip


def _of_modes(name: str, dims: str, key: str, meaning: str) -> Declared:
    return Declared(name, dims, meaning, lambda a: np.array([getattr(m, key) for m in a.modes]), when=SEARCHED)


MODES = (
    _of_modes("mode_centre", "mode parameter", "centre", f"median of its draws, or else minimum of J, {EACH_UNIT}"),
    _of_modes("mode_q05", "mode parameter", "q05", f"5 % of its draws, or else of the Gaussian about it, {EACH_UNIT}"),
    _of_modes("mode_q95", "mode parameter", "q95", f"95 % of its draws, or else of the Gaussian about it, {EACH_UNIT}"),
    _of_modes("mode_cost", "mode", "cost", "J at the minimum, or where none is known the lowest of its draws"),
    _of_modes("mode_weight", "mode", "weight", "probability of the mode"),
    _of_modes("mode_descents", "mode", "descents", "descents that ended there, 0: its draws alone show it"),
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
    return Declared(name, dims, meaning, lambda a: [getattr(shift, key) for shift in shifts(a)], when=RESPONSE)


WHAT_IF = (
    _what_if("what_if_words", "alternative", "words", "if …"),
    _what_if("what_if_change", "alternative parameter", "change",
             f"change of the centre under the alternative, {EACH_UNIT}"),
    _what_if("what_if_relative_change", "alternative parameter", "relative", "the same relative to the centre"),
    _what_if("what_if_change_in_std", "alternative parameter", "in_std", "the same in posterior standard deviations"),
    _what_if("what_if_cost_change", "alternative", "cost_change", "change of J"),
    _what_if("what_if_misfit_change", "alternative", "misfit_change", "change of the readings' part of J"),
    _what_if("what_if_runs_each", "alternative", "runs", "forward runs it took"),
    _what_if("what_if_reason", "alternative", "reason", "why it cannot be told"),
)  # fmt: skip


LEDGERS = (
    Declared("ledger_time", "path_cell path_edge", "begin and end of the cell",
             lambda a: np.column_stack([a.ledger.edges[:-1], a.ledger.edges[1:]]), CELL_TIME, LEDGER),
    Declared("ledger_weight", "path_parameter path_cell", "share of the cell in what informed the parameter",
             lambda a: a.ledger.weights, when=LEDGER),
    Declared("ledger_kernel", "path_parameter path_cell", "averaging kernel of the estimate over the cell",
             lambda a: a.ledger.kernel, when=LEDGER),
    Declared("ledger_{quantity}", "path_cell", "{label}, mean size in the cell",
             lambda a, i: a.ledger.values[i.held], OWN, LEDGER),
    Declared("ledger_{quantity}_quantiles", "path_parameter quantile", "{label}",
             lambda a, i: a.ledger.quantiles[:, i.held], OWN, LEDGER),
)  # fmt: skip

SAMPLE_STATS = (*MEMBERS, *READINGS, *MODES, *WHAT_IF, *LEDGERS)


# All groups, and the coordinates of their dimensions


def _coordinate(name: str, meaning: str, values: Callable[..., Any], **how: Any) -> Declared:
    """CF: a coordinate has no missing values."""
    return Declared(name, name, meaning, values, fill=False, **how)


COORDINATES = (
    _coordinate("chain", "chain", lambda a: np.zeros(1, dtype=np.int64)),
    _coordinate("draw", "ensemble member", lambda a: np.arange(len(a.prior))),
    _coordinate("{time}", "observation time", of_series(lambda a: a.observations.times), unit=READ_TIME),
    _coordinate("withheld_time", "time of readings after the window",
                lambda a: a.withheld.times if a.withheld else np.empty(0), unit=READ_TIME),
    _coordinate("path_time", "time on the clock of the observations", lambda a: a.trajectory_times, unit=TIME),
    _coordinate("parameter", "estimated parameter", lambda a: text(p.name for p in a.parameters), needed=True),
    _coordinate("iteration", "iteration", lambda a: [r.iteration for r in a.iterations]),
    _coordinate("alternative", "assumption that could be otherwise", lambda a: text(s.name for s in shifts(a))),
    _coordinate("path_parameter", "acts along the path", lambda a: text(a.ledger.parameters if a.ledger else ())),
    _coordinate("prior_score", "standard score under the prior", lambda a: SCORES),
    _coordinate("quantile", "quantile under the weights", lambda a: QUANTILES),
    _coordinate("{walk}_piece", "begin of the piece", lambda _, i: (0.0, *i.held.knots), unit=PIECE_TIME),
)  # fmt: skip

GROUPS: dict[str, Table] = {
    "/prior": _parameters(lambda a: a.prior),
    "/posterior": _parameters(lambda a: a.posterior),
    "/prior_predictive": _predictive(lambda a: a.prior_predictions),
    "/prior_paths": _paths(lambda a: a.prior_trajectories),
    "/posterior_predictive": _predictive(lambda a: a.posterior_predictions),
    "/posterior_paths": _paths(lambda a: a.posterior_trajectories),
    "/observed_data": OBSERVED,
    "/observation_errors": ERRORS,
    "/constant_data": CONSTANTS,
    "/sample_stats": SAMPLE_STATS,
    "/log_likelihood": LOG_LIKELIHOOD,
    "/iterations": ITERATIONS,
    "/fields": FIELDS,
    "/withheld": WITHHELD_READINGS,
    "/posterior_draws": DRAWS,
}
OPTIONAL = frozenset({"/fields", "/withheld", "/posterior_draws"})
"""Groups that a file may lack."""
BESIDE = {
    "/observed_data": "/observation_errors",
    "/prior_predictive": "/prior_paths",
    "/posterior_predictive": "/posterior_paths",
}
"""Group → the one that is read together with it."""
NAMED = ("parameter", "series", "shared")  # placeholders that stand for names of a user's
LONGEST_NAME = 250  # bytes; netCDF allows 256


def require_free_names(problem: InverseProblem) -> None:
    """Raise :class:`ConfigError` where a parameter or series has the name of another variable, or of a dimension, or
    one that is too long for a variable, or that netCDF would spell otherwise: it composes letters and accents (NFC).
    """
    subject = SimpleNamespace(problem=problem, parameters=problem.prior.parameters)
    for path, own_table in GROUPS.items():
        table = (*own_table, *GROUPS.get(BESIDE.get(path, ""), ()))
        named = [(d, item) for d in table if d.scope in NAMED for item in SCOPES[d.scope](subject)]
        dims = [dim for d, item in named for dim in d.dims.format(**item.names).split()]
        taken = {"dataset", *dims}  # the first: of the file of a campaign
        taken |= {name for d in table for name in (d.name, *d.dims.split()) if "{" not in name}
        for declared, item in named:
            name = declared.name.format(**item.names)
            kind, own = ("parameter" if "parameter" in item.names else "series"), next(iter(item.names.values()))
            whose = f"the {kind} {own!r} needs another name"
            if name in taken:
                raise ConfigError(f"{whose}: the result has another {name!r} in its group {path[1:]}")
            if len(name.encode()) > LONGEST_NAME:
                raise ConfigError(f"{whose}: {name!r} is too long for a variable of the result")
            if not is_normalized("NFC", name):
                spelt = f"netCDF spells {own!a} as {normalize('NFC', own)!a}; write it so"
                raise ConfigError(f"{whose}: {spelt}")
            taken |= set() if declared.when.words else {name}
