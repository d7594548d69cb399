"""The groups of a result file: an :class:`~en4dvar.analysis.Analysis` laid out in the ArviZ schema.

Every value is SI with ``units`` and ``long_name``; ``display_units`` and ``symbol`` tell tables and figures how to
show it. Members are draws of one chain, in order. Whatever a report needs is put here once, so that nothing downstream
computes it again.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
import numpy.typing as npt

from en4dvar.analysis import Analysis
from en4dvar.diagnostics import nrmse
from en4dvar.state import Array, Parameter
from en4dvar.storage.netcdf import Group, Variable

CONVENTIONS = "CF-1.11 ACDD-1.3"
REFERENCES = (
    "Bocquet & Sakov (2014), doi:10.1002/qj.2236; Sakov, Oliver & Bertino (2012), doi:10.1175/MWR-D-11-00176.1; "
    "layout: ArviZ InferenceData schema"
)
MEMBER = ("chain", "draw")


def build_groups(analysis: Analysis, attributes: Mapping[str, Any]) -> dict[str, Group]:
    """All groups of ``analysis`` by path; ``attributes`` are added to the root's and win over the defaults."""
    groups = {
        "/prior": _parameters(analysis, analysis.prior),
        "/posterior": _parameters(analysis, analysis.posterior),
        "/prior_predictive": _predictive(analysis, analysis.prior_predictions, analysis.prior_trajectories),
        "/posterior_predictive": _predictive(analysis, analysis.posterior_predictions, analysis.posterior_trajectories),
        "/observed_data": _observed(analysis),
        "/constant_data": _constants(analysis),
        "/sample_stats": _sample_stats(analysis),
        "/log_likelihood": _log_likelihood(analysis),
        "/iterations": _iterations(analysis),
    }
    root = {
        "Conventions": CONVENTIONS,
        "title": f"Posterior ensemble of {analysis.name}",
        "source": "en4dvar, ensemble data assimilation (En4D-Var / iterative ensemble Kalman smoother)",
        "references": REFERENCES,
        "dataset": analysis.name,
        "data_source": analysis.observations.source,
        "seed": analysis.seed,
        "assimilation_settings": json.dumps(asdict(analysis.settings)),
        "warnings": "\n".join(c.line for c in analysis.cautions),
    }
    return {"/": Group(attrs=netcdf_attributes({**root, **attributes})), **groups}


def netcdf_attributes(attributes: Mapping[Any, Any]) -> dict[str, Any]:
    """Attributes as netCDF can hold them: truth values become 0/1, absent ones "", other objects their text."""

    def plain(value: Any) -> Any:
        if isinstance(value, bool | np.bool_):
            return int(value)
        if value is None:
            return ""
        return value if isinstance(value, str | int | float | np.number | np.ndarray) else str(value)

    return {str(key): plain(value) for key, value in attributes.items()}


def active_members(failures: Sequence[str]) -> npt.NDArray[np.bool_]:
    """(N,) True where no reason of failure is given."""
    return np.array([reason == "" for reason in failures], dtype=bool)


def _variable(
    dims: str | tuple[str, ...], values: Any, units: str, long_name: str, *, fill: bool = True, **attrs: Any
) -> Variable:
    dims = (dims,) if isinstance(dims, str) else dims
    attributes = netcdf_attributes({"units": units, "long_name": long_name, **attrs})
    return Variable(dims, np.asarray(values), attributes, fill)


def about(p: Parameter) -> dict[str, Any]:
    """What a variable of the parameter says of itself."""
    return {
        "units": p.unit,
        "long_name": p.label,
        "display_units": p.display_unit,
        "symbol": p.symbol,
        "source": p.source,
    }


def _member_coords(n_members: int) -> dict[str, Variable]:
    return {
        "chain": _coordinate("chain", np.zeros(1, dtype=np.int64), "1", "chain"),
        "draw": _coordinate("draw", np.arange(n_members), "1", "ensemble member"),
    }


def _coordinate(dim: str, values: Any, units: str, long_name: str, **attrs: Any) -> Variable:
    return _variable(dim, values, units, long_name, fill=False, **attrs)  # CF: a coordinate has no missing values


def _time(a: Analysis, dim: str, values: Array, long_name: str) -> Variable:
    return _coordinate(dim, values, a.time_unit, long_name, display_units=a.time_display_unit, axis="T")


def _parameters(a: Analysis, members: Array) -> Group:
    """(N, n) physical values → one variable (chain, draw) a parameter."""
    variables = {
        p.name: Variable(MEMBER, members[None, :, i], netcdf_attributes(about(p))) for i, p in enumerate(a.parameters)
    }
    return Group(variables, _member_coords(len(members)))


def _observable(a: Analysis, dims: tuple[str, ...], values: Array, what: str) -> Variable:
    o = a.observable
    return _variable(dims, values, o.unit, f"{o.label}, {what}", display_units=o.display_unit, symbol=o.symbol)


def _predictive(a: Analysis, predictions: Array, paths: Array) -> Group:
    name = a.observable.name
    return Group(
        {
            name: _observable(a, (*MEMBER, "time"), predictions[None], "noise-free prediction at the observations"),
            f"{name}_path": _observable(a, (*MEMBER, "path_time"), paths[None], "noise-free prediction along the path"),
        },
        {
            **_member_coords(len(predictions)),
            "time": _time(a, "time", a.observations.times, "observation time"),
            "path_time": _time(a, "path_time", a.trajectory_times, "time on the clock of the observations"),
        },
    )


def _observed(a: Analysis) -> Group:
    name, obs = a.observable.name, a.observations
    scalars = {f"scalar_{key}": value for key, value in obs.scalars.items()}
    scalars |= obs.noise.attributes()
    further = {}
    for key, (matrix, text) in obs.noise.matrices().items():
        further[f"{name}_{key}"] = _variable(("time", "time_column"), matrix, "1", text)
    if a.huber_weight is not None:
        text = "weight of the observation in the robust cost at its minimum"
        further[f"{name}_huber_weight"] = _variable("time", a.huber_weight, "1", text)
    return Group(
        {
            name: _observable(a, ("time",), obs.values, "observed"),
            f"{name}_std": _observable(a, ("time",), a.error_std, "observation-error std, timing error included"),
            f"{name}_reading_std": _observable(a, ("time",), obs.std, "observation-error std of the reading alone"),
            "time_std": _time(a, "time", obs.noise.time_std, "std of the observation times"),
            "weights": _variable("time", obs.weights, "1", "weight of the observation in the cost"),
            **further,
        },
        {"time": _time(a, "time", obs.times, "observation time")},
        netcdf_attributes({"name": obs.name, "data_source": obs.source, **scalars}),
    )


def _constants(a: Analysis) -> Group:
    known = {p.name: about(p) for p in a.fixed_parameters}
    unknown = {"units": "1", "long_name": "fixed value"}
    return Group(
        {
            name: Variable((), np.asarray(value), netcdf_attributes(known.get(name, {**unknown, "symbol": name})))
            for name, value in a.fixed.items()
        }
    )


def _sample_stats(a: Analysis) -> Group:
    """Which members live and why not, the centre (minimum of J), DFS, and the scalars that judge the fit."""
    name, y = a.observable.name, a.observations.values
    active = active_members(a.posterior_failures)
    last = a.iterations[-1]
    scalars = {
        "n_members": len(active),
        "n_active": int(active.sum()),
        "n_observations": len(y),
        "n_weighted": int(np.sum(a.observations.weights > 0)),
        "nrmse": nrmse(y, a.posterior_predictions[active].mean(axis=0)) if active.any() else np.nan,
        "nrmse_centre": nrmse(y, a.centre_predictions),
        "chi2_per_observation": last.chi2_per_observation,
        "cost": last.cost,
        "dfs": last.dfs,
        "log_evidence": a.log_evidence,
        "n_iterations": len(a.iterations),
        "converged": a.converged,
        "stop_reason": a.stop_reason,
        "forward_runs": a.forward_runs,
        "warning_codes": " ".join(dict.fromkeys(c.code for c in a.cautions)),
        **a.shape,
        **a.refinement,
    }
    reached = {
        f"{limit.name}_reached": _variable(
            MEMBER,
            a.extremes[None, :, i],
            limit.unit,
            limit.label,
            limit=limit.value,
            source=limit.source,
        )
        for i, limit in enumerate(a.limits)
    }
    reason = "reason of failure, empty where the member is alive"
    return Group(
        {
            "active": _variable(MEMBER, active[None], "1", "member survived the posterior forecast"),
            "failure_reason": _variable(MEMBER, _text(a.posterior_failures)[None], "1", reason),
            "prior_active": _variable(
                MEMBER, active_members(a.prior_failures)[None], "1", "member survived the prior forecast"
            ),
            "prior_failure_reason": _variable(MEMBER, _text(a.prior_failures)[None], "1", f"prior: {reason}"),
            "centre": _variable(
                "parameter", a.centre, "1", "value at the minimum of J, each in the unit of its parameter"
            ),
            "dfs": _variable("parameter", a.dfs_per_parameter, "1", "degrees of freedom for signal of the parameter"),
            f"{name}_centre": _observable(a, ("time",), a.centre_predictions, "prediction at the minimum of J"),
            **reached,
        },
        {
            **_member_coords(len(active)),
            "parameter": _coordinate("parameter", _text([p.name for p in a.parameters]), "1", "estimated parameter"),
            "time": _time(a, "time", a.observations.times, "observation time"),
        },
        netcdf_attributes(scalars),
    )


def _text(strings: Sequence[str]) -> npt.NDArray[np.object_]:
    return np.array(strings, dtype=object)


def _log_likelihood(a: Analysis) -> Group:
    label = f"{a.observable.label}, log-likelihood of each observation"
    return Group(
        {a.observable.name: _variable((*MEMBER, "time"), a.log_likelihood[None], "1", label)},
        {
            **_member_coords(len(a.log_likelihood)),
            "time": _time(a, "time", a.observations.times, "observation time"),
        },
    )


ITERATION_SCALARS = {
    "J": ("cost", "cost J"),
    "J_background": ("background", "background term of J"),
    "J_observation": ("observation", "observation term of J"),
    "step_norm": ("step_norm", "norm of the step in weights"),
    "step_length": ("step_length", "fraction of the step taken"),
    "chi2_per_observation": ("chi2_per_observation", "chi-squared per observation"),
    "dfs": ("dfs", "degrees of freedom for signal"),
    "spread": ("spread", "ensemble spread"),
    "active": ("active", "members alive"),
}


def _iterations(a: Analysis) -> Group:
    """Diagnostics (iteration,), the ensemble each iterate describes (iteration, draw) and its centre (iteration,)."""
    records = a.iterations
    variables = {
        key: _variable("iteration", np.array([getattr(r, field) for r in records]), "1", label)
        for key, (field, label) in ITERATION_SCALARS.items()
    }
    members = np.stack([r.members for r in records])
    centres = np.stack([r.centre for r in records])
    for i, p in enumerate(a.parameters):
        attrs = netcdf_attributes(about(p))
        variables[p.name] = Variable(("iteration", "draw"), members[:, :, i], attrs)
        variables[f"{p.name}_centre"] = Variable(
            ("iteration",), centres[:, i], {**attrs, "long_name": f"{p.label}, centre"}
        )
    index = _coordinate("iteration", np.array([r.iteration for r in records]), "1", "iteration")
    return Group(variables, {"iteration": index, "draw": _member_coords(members.shape[1])["draw"]})
