"""The attributes of the result of one data set, declared once, group by group."""

import json
import math
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from typing import Any

import numpy as np

from en4dvar.data.noise import BlockNoise
from en4dvar.diagnosis.analysis import Analysis
from en4dvar.diagnosis.diagnostics import active_members, nrmse
from en4dvar.model.state import Array
from en4dvar.plumbing.caution import codes
from en4dvar.results.declared import Attribute

CONVENTIONS = "CF-1.11 ACDD-1.3"
REFERENCES = (
    "Bocquet & Sakov (2014), doi:10.1002/qj.2236; Sakov, Oliver & Bertino (2012), doi:10.1175/MWR-D-11-00176.1; "
    "layout: ArviZ InferenceData schema"
)
SOURCE = "en4dvar, ensemble data assimilation (En4D-Var / iterative ensemble Kalman smoother)"
MOST_WRITTEN = 50  # parameters of a block of correlated ones whose matrix is an attribute
UNTOLD = "with heavy tails beside a discrepancy no single reading has a density of its own given the others"
SCALAR = "scalar_"  # begins the attribute of a number that came with the data


def _json(name: str, meaning: str, value: Callable[[Analysis], Any]) -> Attribute:
    """An attribute that is written as JSON where there is anything."""
    return Attribute(name, f"{meaning}, JSON", lambda a: json.dumps(held) if (held := value(a)) else None)


def _correlated(a: Analysis) -> list[dict[str, Any]]:
    return [
        {"names": block.names, "correlation": block.matrix.tolist() if len(block.names) <= MOST_WRITTEN else []}
        for block in a.problem.prior.blocks
    ]


def _tied(a: Analysis) -> dict[str, Any]:
    return {tie.parameter.name: [tie.to, tie.factor] for tie in a.problem.tied}


def _thresholds(a: Analysis) -> dict[str, float]:
    """Of each series with a robust cost, how many std a residual may have before it counts less."""
    noise, stated = a.observations.noise, a.observations
    if not stated.parts:
        return noise.attributes()
    each = noise.thresholds if isinstance(noise, BlockNoise) else np.full(len(stated), noise.counts_within)
    of_parts = {f"{part.name}_huber_threshold": float(each[part.begin]) for part in stated.parts}
    return {name: threshold for name, threshold in of_parts.items() if math.isfinite(threshold)}


def _nrmse(a: Analysis, predicted: Array) -> float:
    """Of readings that count; of several series, in units of their own, from the mean of (1 − NRMSE)² over those that
    vary.
    """
    y, used = a.observations.values, a.observations.used
    of_parts = [used[(p.begin <= used) & (used < p.end)] for p in a.problem.parts]
    each = [nrmse(y[k], predicted[k]) for k in of_parts if len(k) and np.ptp(y[k]) > 0]
    return float(1 - np.sqrt(np.mean((1 - np.array(each)) ** 2))) if each else np.nan


def _nrmse_of_mean(a: Analysis) -> float:
    active = active_members(a.posterior_failures)
    return _nrmse(a, a.posterior_predictions[active].mean(axis=0)) if active.any() else np.nan


def _untold(a: Analysis) -> str:
    if a.influence is not None:
        return ""
    noise = a.observations.noise
    return UNTOLD if noise.discrepant and math.isfinite(noise.counts_within) else "too few members"


def _discrepancy_share(a: Analysis) -> float | None:
    if a.discrepancy is None:
        return None
    residual = a.observations.values - a.centre_predictions
    left = residual - a.discrepancy.mean
    return 1 - float(left @ left) / (float(residual @ residual) or np.nan)


def _of(part: Callable[[Analysis], Any], name: str, meaning: str, value: Callable[[Any], Any]) -> Attribute:
    """An attribute of a part of an analysis, which is written where there is one."""
    return Attribute(name, meaning, lambda a: None if (held := part(a)) is None else value(held))


_withheld = partial(_of, lambda a: a.withheld)
_residual = partial(_of, lambda a: a.residuals if a.residuals and a.residuals.enough else None)
_change = partial(_of, lambda a: None if a.log_evidence_change is None else a)  # of parameters that may vary in time
_search = partial(_of, lambda a: a.descents)  # of a scheme that searches for several minima


ROOT = (
    Attribute("Conventions", "the conventions that the file follows", lambda a: CONVENTIONS),
    Attribute("title", "what the file is", lambda a: f"Posterior ensemble of {a.name}"),
    Attribute("source", "the program", lambda a: SOURCE),
    Attribute("references", "literature", lambda a: REFERENCES),
    Attribute("dataset", "name of the data set", lambda a: a.name, needed=True),
    Attribute("data_source", "where the data come from", lambda a: a.observations.source),
    Attribute("seed", "seed of this data set", lambda a: a.seed),
    Attribute("assimilation_settings", "settings of the scheme, JSON",
              lambda a: json.dumps(a.settings.keys, default=asdict), needed=True),
    Attribute("warnings", "one a line", lambda a: "\n".join(c.line for c in a.cautions), needed=True),
)  # fmt: skip
OBSERVED = (
    Attribute("name", "name of the data set", lambda a: a.observations.name),
    Attribute("data_source", "where the data come from", lambda a: a.observations.source, needed=True),
    Attribute("scalar_…", "numbers that came with the data",
              lambda a: {f"{SCALAR}{key}": value for key, value in a.observations.scalars.items()}),
    Attribute("huber_threshold, discrepancy_…", "numbers that say of which kind the errors are", _thresholds),
)  # fmt: skip
SAMPLE_STATS = (
    Attribute("n_members", "members", lambda a: len(a.posterior_failures), needed=True),
    Attribute("n_active", "members that ran", lambda a: int(active_members(a.posterior_failures).sum()), needed=True),
    Attribute("n_observations", "readings", lambda a: len(a.observations), needed=True),
    Attribute("n_weighted", "readings that count", lambda a: len(a.observations.used), needed=True),
    Attribute("nrmse", "1 − ‖y − ŷ‖/‖y − ȳ‖ of the ensemble mean", _nrmse_of_mean, needed=True),
    Attribute("nrmse_centre", "the same at the minimum of J", lambda a: _nrmse(a, a.centre_predictions)),
    Attribute("chi2_per_observation", "χ² per reading, of σ as its posterior has it", lambda a: a.fit[0], needed=True),
    Attribute("cost", "J at its minimum", lambda a: a.iterations[-1].cost),
    Attribute("dfs", "degrees of freedom for signal", lambda a: a.fit[1], needed=True),
    Attribute("log_evidence", "ln p(y)", lambda a: a.log_evidence),
    _change("varying", "what varies in time", lambda a: " and ".join(v.label for v in a.problem.varying)),
    _change("log_evidence_constant", "ln p(y) with constant parameters", lambda a: a.log_evidence_constant),
    _change("log_evidence_change", "the difference of both", lambda a: a.log_evidence_change),
    Attribute("n_iterations", "iterations", lambda a: len(a.iterations), needed=True),
    Attribute("converged", "1: by its own criterion", lambda a: a.converged, needed=True),
    Attribute("stop_reason", "why the iterations ended", lambda a: a.stop_reason, needed=True),
    Attribute("forward_runs", "runs of the model", lambda a: a.forward_runs, needed=True),
    Attribute("n_modes", "minima of J that hold some of the probability", lambda a: len(a.modes)),
    _search("n_descents", "descents", lambda d: len(d.members)),
    _search("n_agreeing", "descents from different members that ended in the lowest minimum", lambda d: d.agreeing),
    _search("cost_spread", "by how much their J differ", lambda d: d.spread),
    _search("search_runs", "forward runs of the descents that looked for another minimum", lambda d: d.runs),
    _search("descents", "the same in words", lambda d: d.words),
    Attribute("what_if_runs", "forward runs of the alternatives", lambda a: sum(shift.runs for shift in a.what_if)),
    Attribute("ledger_runs", "forward runs of the ledger", lambda a: a.ledger.runs if a.ledger else 0),
    Attribute("warning_codes", "codes of the warnings", lambda a: " ".join(codes(a.cautions))),
    Attribute("influence_reason", 'why the influence of readings cannot be told, or ""', _untold),
    _residual("residual_lag_one", "autocorrelation of neighbouring residuals", lambda r: r.lag_one),
    _residual("residual_lag_one_chance", "its chance where the model is right", lambda r: r.lag_one_chance),
    _residual("residual_runs", "runs of one sign", lambda r: r.runs[0]),
    _residual("residual_runs_expected", "runs expected", lambda r: r.runs[1]),
    _residual("residual_runs_chance", "their chance where the model is right", lambda r: r.runs_chance),
    _residual("residual_collapse_chance", "chance of the residuals where the observable is fast",
              lambda r: r.collapse_chance),
    _residual("residual_outlier_chance", "chance of the largest residual", lambda r: r.outlier[1]),
    _withheld("withheld_readings", "readings after the window", lambda w: len(w.values)),
    _withheld("withheld_inside", "share of them in the 90 % bands of what was expected", lambda w: w.inside),
    _withheld("withheld_rms", "root mean square of these readings less the medians, SI", lambda w: w.rms),
    Attribute("discrepancy_share", "share of the squared residuals that the discrepancy takes", _discrepancy_share),
    Attribute("gaussian_fit, non_gaussian, tail_shift, tail_ratio, tail_excess, tail_members, tail_elsewhere, "
              "tail_mean_G, tail_std_G, tail_end, tail_q05_G, tail_q95_G, mean_shift, spread_ratio, emulator_fit, "
              "emulated_mean_G, emulated_std_G",
              "shape of the posterior; tail_mean, tail_std where weights are sure, NaN of few; tail_q05, tail_q95 of "
              "an interval whose end is off; rest of an emulator",
              lambda a: a.shape),
    Attribute("importance_draws, importance_effective_sample_size, importance_largest_shift, "
              "importance_largest_spread_ratio, mcmc_r_hat, mcmc_effective_sample_size, …",
              "of a posterior that was sampled", lambda a: a.refinement),
)  # fmt: skip
ATTRIBUTES: dict[str, tuple[Attribute, ...]] = {
    "/": ROOT,
    "/prior": (_json("correlated", "parameters that are correlated in the prior", _correlated),),
    "/observed_data": OBSERVED,
    "/constant_data": (_json("tied", "parameters that follow another one, and the factors", _tied),),
    "/sample_stats": SAMPLE_STATS,
}
