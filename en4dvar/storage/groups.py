"""The groups of a result file: an :class:`~en4dvar.analysis.Analysis` laid out in the ArviZ schema.

Every value is SI with ``units`` and ``long_name``; ``display_units`` and ``symbol`` tell tables and figures how to
show it. Members are draws of one chain, in order. Whatever a report needs is put here once, so that nothing downstream
computes it again.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
import numpy.typing as npt

from en4dvar.analysis import Analysis
from en4dvar.caution import codes
from en4dvar.diagnostics import active_members, nrmse
from en4dvar.state import Array, Parameter
from en4dvar.storage.fields import field_groups
from en4dvar.storage.modes import descent_scalars, mode_variables
from en4dvar.storage.netcdf import Group, netcdf_attributes
from en4dvar.storage.netcdf import variable as _variable
from en4dvar.storage.readings import (
    MEMBER,
    Variables,
    log_likelihood,
    observable_variable,
    observed,
    paths,
    predictive,
    readings,
    residuals,
    series_of,
    stated,
    time_variable,
)
from en4dvar.storage.responses import response_coordinates, response_variables
from en4dvar.storage.varying import change_scalars, piece_coordinates, pieces

CONVENTIONS = "CF-1.11 ACDD-1.3"
REFERENCES = (
    "Bocquet & Sakov (2014), doi:10.1002/qj.2236; Sakov, Oliver & Bertino (2012), doi:10.1175/MWR-D-11-00176.1; "
    "layout: ArviZ InferenceData schema"
)
MOST_WRITTEN = 50  # parameters of a block of correlated ones whose matrix is an attribute
UNTOLD = "with heavy tails beside a discrepancy no single reading has a density of its own given the others"


def build_groups(a: Analysis, attributes: Mapping[str, Any]) -> dict[str, Group]:
    """All groups of an analysis by path; ``attributes`` are added to the root's and win over the defaults."""
    coordinates = _coordinates(a)

    def group(variables: Variables, attributes: Mapping[str, Any] | None = None) -> Group:
        dims = dict.fromkeys(dim for variable in variables.values() for dim in variable.dims)
        own = {dim: coordinates[dim] for dim in dims if dim in coordinates}
        return Group(variables, own, netcdf_attributes(attributes or {}))

    root = {
        "Conventions": CONVENTIONS,
        "title": f"Posterior ensemble of {a.name}",
        "source": "en4dvar, ensemble data assimilation (En4D-Var / iterative ensemble Kalman smoother)",
        "references": REFERENCES,
        "dataset": a.name,
        "data_source": a.observations.source,
        "seed": a.seed,
        "assimilation_settings": json.dumps(asdict(a.settings)),
        "warnings": "\n".join(c.line for c in a.cautions),
    }
    return {
        "/": Group(attrs=netcdf_attributes({**root, **attributes})),
        "/prior": group({**_parameters(a, a.prior), **pieces(a, a.prior)}, _correlated(a)),
        "/posterior": group({**_parameters(a, a.posterior), **pieces(a, a.posterior)}),
        "/prior_predictive": group(predictive(a, a.prior_predictions)),
        "/prior_paths": group(paths(a, a.prior_trajectories)),
        "/posterior_predictive": group(predictive(a, a.posterior_predictions)),
        "/posterior_paths": group(paths(a, a.posterior_trajectories)),
        "/observed_data": group(*observed(a)),
        "/observation_errors": group(stated(a)),
        "/constant_data": group(_constants(a), _tied(a)),
        "/sample_stats": group(_sample_stats(a), _scalars(a)),
        "/log_likelihood": group(log_likelihood(a)),
        "/iterations": group(_iterations(a)),
        **field_groups(a),
    }


def _correlated(a: Analysis) -> dict[str, Any]:
    """Which parameters are correlated in the prior, in transformed space; of large blocks their names alone."""
    blocks = [
        {"names": block.names, "correlation": block.matrix.tolist() if len(block.names) <= MOST_WRITTEN else []}
        for block in a.problem.prior.blocks
    ]
    return {"correlated": json.dumps(blocks)} if blocks else {}


def _tied(a: Analysis) -> dict[str, Any]:
    """Which parameters follow another one, and by which factor."""
    tied = {tie.parameter.name: [tie.to, tie.factor] for tie in a.problem.tied}
    return {"tied": json.dumps(tied)} if tied else {}


def about(p: Parameter) -> dict[str, Any]:
    """What a variable of the parameter says of itself."""
    return {
        "units": p.unit,
        "long_name": p.label,
        "display_units": p.display_unit,
        "symbol": p.symbol,
        "source": p.source,
    }


def _coordinates(a: Analysis) -> Variables:
    """Of every dimension that has one. CF: a coordinate has no missing values."""
    names = _text([p.name for p in a.parameters])
    return {
        "chain": _variable("chain", np.zeros(1, dtype=np.int64), "1", "chain", fill=False),
        "draw": _variable("draw", np.arange(len(a.prior)), "1", "ensemble member", fill=False),
        **{
            axis.time: time_variable(a, axis.time, a.observations.times[part.where], "observation time")
            for axis, part in series_of(a)
        },
        "path_time": time_variable(a, "path_time", a.trajectory_times, "time on the clock of the observations"),
        "parameter": _variable("parameter", names, "1", "estimated parameter", fill=False),
        "iteration": _variable("iteration", [r.iteration for r in a.iterations], "1", "iteration", fill=False),
        **response_coordinates(a),
        **piece_coordinates(a),
    }


def _parameters(a: Analysis, members: Array) -> Variables:
    """(N, n) physical values → one variable (chain, draw) a parameter."""
    return {p.name: _variable(MEMBER, members[None, :, i], **about(p)) for i, p in enumerate(a.parameters)}


def _constants(a: Analysis) -> Variables:
    known = {p.name: about(p) for p in a.fixed_parameters}
    unknown = {"units": "1", "long_name": "fixed value"}
    return {
        name: _variable((), value, **known.get(name, {**unknown, "symbol": name}))
        for name, value in a.problem.fixed.items()
    }


def _sample_stats(a: Analysis) -> Variables:
    """Which members live and why not, the centre (minimum of J) and DFS."""
    active, prior_active = active_members(a.posterior_failures), active_members(a.prior_failures)
    reason = "reason of failure, empty where the member is alive"
    centre = "value at the minimum of J, each in the unit of its parameter"
    return {
        "active": _variable(MEMBER, active[None], "1", "member survived the posterior forecast"),
        "failure_reason": _variable(MEMBER, _text(a.posterior_failures)[None], "1", reason),
        "prior_active": _variable(MEMBER, prior_active[None], "1", "member survived the prior forecast"),
        "prior_failure_reason": _variable(MEMBER, _text(a.prior_failures)[None], "1", f"prior: {reason}"),
        "centre": _variable("parameter", a.centre, "1", centre),
        "dfs": _variable("parameter", a.dfs_per_parameter, "1", "degrees of freedom for signal of the parameter"),
        **{
            f"{part.name}_centre": observable_variable(
                part, (axis.time,), a.centre_predictions[part.where], "prediction at the minimum of J"
            )
            for axis, part in series_of(a)
        },
        **residuals(a),
        **_discrepancy(a),
        **readings(a),
        **{
            f"{v.name}_reached": _variable(
                MEMBER, a.extremes[None, :, i], v.unit, v.label, limit=v.value, source=v.source
            )
            for i, v in enumerate(a.problem.model.validity)
        },
        **mode_variables(a),
        **response_variables(a),
    }


SHARES = ("errors", "discrepancy", "prior")


def _discrepancy(a: Analysis) -> Variables:
    """What the model misses (time), and where the variance of each parameter comes from (parameter)."""
    (part, *_), found = a.problem.parts, a.discrepancy
    if found is None:
        return {}
    name = part.name
    shares = {
        f"variance_from_{source}": _variable(
            "parameter", found.shares[:, i], "1", f"share of the posterior variance that comes from the {source}"
        )
        for i, source in enumerate(SHARES)
    }
    return {
        f"{name}_discrepancy": observable_variable(
            part, ("time",), found.mean, "what the model misses, at the minimum of J"
        ),
        f"{name}_discrepancy_std": observable_variable(part, ("time",), found.std, "std of what the model misses"),
        **shares,
    }


def _scalars(a: Analysis) -> dict[str, Any]:
    """What judges the fit as a whole."""
    active, last = active_members(a.posterior_failures), a.iterations[-1]
    return {
        "n_members": len(active),
        "n_active": int(active.sum()),
        "n_observations": len(a.observations),
        "n_weighted": len(a.observations.used),
        "nrmse": _nrmse(a, a.posterior_predictions[active].mean(axis=0)) if active.any() else np.nan,
        "nrmse_centre": _nrmse(a, a.centre_predictions),
        "chi2_per_observation": last.chi2_per_observation,
        "cost": last.cost,
        "dfs": last.dfs,
        "log_evidence": a.log_evidence,
        **change_scalars(a),
        "n_iterations": len(a.iterations),
        "converged": a.converged,
        "stop_reason": a.stop_reason,
        "forward_runs": a.forward_runs,
        "n_modes": len(a.modes),
        **descent_scalars(a),
        "what_if_runs": sum(shift.runs for shift in a.what_if),
        "ledger_runs": a.ledger.runs if a.ledger else 0,
        "warning_codes": " ".join(codes(a.cautions)),
        "influence_reason": _untold(a),
        **_judged_residuals(a),
        **a.shape,
        **a.refinement,
    }


def _nrmse(a: Analysis, predicted: Array) -> float:
    """Of several series, in units of their own, from the mean of (1 − NRMSE)² over those that vary."""
    if not a.observations.parts:
        return nrmse(a.observations.values, predicted)
    y = a.observations.values
    each = [nrmse(y[p.where], predicted[p.where]) for p in a.problem.parts if np.ptp(y[p.where]) > 0]
    return float(1 - np.sqrt(np.mean((1 - np.array(each)) ** 2))) if each else np.nan


def _judged_residuals(a: Analysis) -> dict[str, Any]:
    """Numbers that say whether the residuals have a structure; none where there are too few readings."""
    found = a.residuals
    numbers: dict[str, Any] = {}
    if found is not None and found.enough:
        numbers |= {
            "residual_lag_one": found.lag_one,
            "residual_lag_one_chance": found.lag_one_chance,
            "residual_runs": found.runs[0],
            "residual_runs_expected": found.runs[1],
            "residual_runs_chance": found.runs_chance,
            "residual_collapse_chance": found.collapse_chance,
            "residual_outlier_chance": found.outlier[1],
        }
    if a.discrepancy is not None:
        residual = a.observations.values - a.centre_predictions
        left = residual - a.discrepancy.mean
        numbers["discrepancy_share"] = 1 - float(left @ left) / (float(residual @ residual) or np.nan)
    return numbers


def _untold(a: Analysis) -> str:
    """Why it is not known what leaving out a reading would change; "" where it is."""
    noise = a.observations.noise
    if a.influence is not None:
        return ""
    return UNTOLD if noise.discrepant and math.isfinite(noise.counts_within) else "too few members"


def _text(strings: Sequence[str]) -> npt.NDArray[np.object_]:
    return np.array(strings, dtype=object)


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


def _iterations(a: Analysis) -> Variables:
    """Diagnostics (iteration,), the ensemble each iterate describes (iteration, draw) and its centre (iteration,)."""
    records = a.iterations
    variables = {
        key: _variable("iteration", [getattr(r, field) for r in records], "1", label)
        for key, (field, label) in ITERATION_SCALARS.items()
    }
    members = np.stack([r.members for r in records])
    centres = np.stack([r.centre for r in records])
    for i, p in enumerate(a.parameters):
        centre = {**about(p), "long_name": f"{p.label}, centre"}
        variables[p.name] = _variable(("iteration", "draw"), members[:, :, i], **about(p))
        variables[f"{p.name}_centre"] = _variable("iteration", centres[:, i], **centre)
    return variables
