"""The variables of the result of one data set, declared once, group by group.

A data set of one observable has the dimension ``time``, and its weights are ``weights``. Of several series each has a
dimension of its own, ``<name>_time``, and ``<name>_weights``. Every value is SI; members are draws of one chain, in
order. Whatever a report needs is stored, so that nothing downstream computes it again.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from en4dvar.diagnosis.analysis import Analysis
from en4dvar.diagnosis.response.ledger import QUANTILES
from en4dvar.model.state import Array
from en4dvar.results.declared import MEMBER, OWN, Declared, Item, Table, text
from en4dvar.results.sample_stats import SAMPLE_STATS, SCORES, shifts
from en4dvar.results.scopes import (
    AT,
    FIXED,
    PATH,
    PIECE_TIME,
    PLACE,
    PLACED,
    ROBUST,
    SAMPLED,
    TIME,
    WITHHELD,
    of_series,
)


def _parameters(members: Callable[[Analysis], Array]) -> Table:
    """Physical values of members (N, n)."""
    return (
        Declared("{parameter}", MEMBER, "{label}", lambda a, i: members(a)[None, :, i.held], OWN, needed=True),
        Declared("{walk}_pieces", f"{MEMBER} {{walk}}_piece", "{label}, over the pieces of time",
                 lambda a, i: a.pieces(i.held, members(a))[None], OWN),
    )  # fmt: skip


def _predictive(members: Callable[[Analysis], Array]) -> Table:
    """Predictions of members (N, K)."""
    return (
        Declared("{series}", f"{MEMBER} {{time}}", "{label}, noise-free prediction at the observations",
                 of_series(lambda a: members(a)[None]), OWN, needed=True),
    )  # fmt: skip


def _paths(members: Callable[[Analysis], Array]) -> Table:
    """Paths of members; those of several series stand side by side."""

    def path(a: Analysis, item: Item) -> Array | npt.NDArray[np.float32]:
        width = len(a.trajectory_times)
        place = [part.name for part in a.problem.parts if part.has_path].index(item.held.name)
        return _to_draw(members(a)[None, :, place * width : (place + 1) * width])

    dims = f"{MEMBER} path_time"
    return (Declared("{series}_path", dims, "{label}, noise-free prediction along the path", path, OWN, PATH),)


def _to_draw(path: Array) -> Array | npt.NDArray[np.float32]:
    """In single precision, unless that cannot hold a value: curves are for figures, and most of what a result is."""
    with np.errstate(over="ignore", under="ignore"):
        single = path.astype(np.float32)
    return single if np.allclose(single, path, rtol=1e-6, atol=0.0, equal_nan=True) else path


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


def _cells(name: str, key: str, meaning: str) -> Declared:
    return Declared(name, "{field}_cell", f"{{label}}, {meaning}", lambda _, i: getattr(i.held, key), OWN)


FIELDS = (
    Declared("{field}", "draw {field}_cell", "{label}, posterior members", lambda _, i: i.held.members, OWN,
             single=True),
    _cells("{field}_mean", "mean", "posterior mean"),
    _cells("{field}_std", "std", "posterior standard deviation"),
    _cells("{field}_centre", "centre", "value at the minimum of J"),
    _cells("{field}_prior_mean", "prior_mean", "prior mean"),
    _cells("{field}_prior_std", "prior_std", "prior standard deviation"),
    Declared("{field}_at", "{field}_cell {field}_axis", "where the cells are", lambda _, i: i.held.prior.places, AT),
)  # fmt: skip


DRAWS = (
    Declared("{parameter}", "posterior_draw", "{label}, equally likely draws beside the members",
             lambda a, i: a.draws[:, i.held], OWN, SAMPLED),
)  # fmt: skip


def _expected(name: str, meaning: str, key: str) -> Declared:
    return Declared(name, "withheld_time", meaning, lambda a, _: getattr(a.withheld, key), OWN, WITHHELD)


def _of_later(key: str) -> Callable[..., Array]:
    """Of the errors of the readings after the window."""
    return lambda a, *_: getattr(a.observations.continued.noise, key)[len(a.observations) :]


WITHHELD_READINGS = (
    _expected("{series}", "{label}, read after the window", "values"),
    _expected("{series}_low", "{label}, 5 % of what was expected", "low"),
    _expected("{series}_median", "{label}, median of what was expected", "median"),
    _expected("{series}_high", "{label}, 95 % of what was expected", "high"),
    Declared("{series}_reading_std", "withheld_time", "{label}, observation-error std of the reading alone",
             _of_later("std"), OWN, WITHHELD),
    Declared("time_std", "withheld_time", "std of the observation times", _of_later("time_std"), TIME, WITHHELD,
             fill=False),
)  # fmt: skip


def _coordinate(name: str, meaning: str, values: Callable[..., Any], **how: Any) -> Declared:
    """CF: a coordinate has no missing values."""
    return Declared(name, name, meaning, values, fill=False, **how)


COORDINATES = (
    _coordinate("chain", "chain", lambda a: np.zeros(1, dtype=np.int64)),
    _coordinate("draw", "ensemble member", lambda a: np.arange(len(a.prior))),
    _coordinate("{time}", "observation time", of_series(lambda a: a.observations.times), unit=TIME),
    _coordinate(
        "withheld_time",
        "time of readings after the window",
        lambda a: a.withheld.times if a.withheld else np.empty(0),
        unit=TIME,
    ),
    _coordinate("path_time", "time on the clock of the observations", lambda a: a.trajectory_times, unit=TIME),
    _coordinate("parameter", "estimated parameter", lambda a: text(p.name for p in a.parameters), needed=True),
    _coordinate("iteration", "iteration", lambda a: [r.iteration for r in a.iterations]),
    _coordinate("alternative", "assumption that could be otherwise", lambda a: text(s.name for s in shifts(a))),
    _coordinate("path_parameter", "acts along the path", lambda a: text(a.ledger.parameters if a.ledger else ())),
    _coordinate("prior_score", "standard score under the prior", lambda a: SCORES),
    _coordinate("quantile", "quantile under the weights", lambda a: QUANTILES),
    _coordinate("{walk}_piece", "begin of the piece", lambda _, i: (0.0, *i.held.knots), unit=PIECE_TIME),
)

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
