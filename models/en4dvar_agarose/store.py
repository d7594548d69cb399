"""A study as one netCDF file: a group a gel and model with both routes, and a population's draws."""

from datetime import UTC, datetime

import numpy as np

from en4dvar.estimation.population import Population
from en4dvar.model.state import Array, Parameter
from en4dvar.results.netcdf import Group, SealedBytes, Variable, to_bytes, variable
from en4dvar_agarose.fits import Fit, Study
from en4dvar_agarose.paper import Route


def study_netcdf(study: Study) -> SealedBytes:
    """Groups ``/<gel>/<model>``: ``sweep_<parameter>`` (dataset), ``<parameter>`` (dataset, draw) of the posterior
    ensembles, NRMSE, log-evidence, DFS, ``truth_<parameter>``; ``/<gel>/population``: draws of mean and spread. SI.
    """
    about = {
        "Conventions": "CF-1.8",
        "title": f"Acoustic cavitation rheometry: {study.plan.name}"
        + (" (SYNTHETIC twin, no measurement)" if study.plan.synthetic else ""),
        "source": "en4dvar study; after Mancia et al. (2021), Acoustic Cavitation Rheometry",
        "history": f"{datetime.now(UTC):%Y-%m-%dT%H:%M:%SZ} written by en4dvar study",
        "configuration": study.plan.text,
    }
    groups = {"/": Group(attrs=about)}
    for gel, models in study.fits.items():
        name = gel.replace("/", "_")
        groups[f"/{name}"] = Group(attrs={"gel": gel})
        for model, fit in models.items():
            groups[f"/{name}/{model}"] = _fit(study, fit)
        if gel in study.populations:
            groups[f"/{name}/population"] = _population(study.populations[gel])
    return to_bytes(groups)


def _fit(study: Study, fit: Fit) -> Group:
    variables: dict[str, Variable] = {}
    for j, p in enumerate(fit.prior.parameters):
        variables[p.name] = _of(p, ("dataset", "draw"), np.stack([a.posterior[:, j] for a in fit.analyses]))
        dfs = [a.dfs_per_parameter[j] for a in fit.analyses]
        variables[f"dfs_{p.name}"] = variable("dataset", dfs, "1", f"DFS of {p.name}")
        truths = np.array([study.truth.get(name, {}).get(p.name, np.nan) for name in fit.names])
        if study.truth and np.isfinite(truths).any():
            variables[f"truth_{p.name}"] = _of(p, "dataset", truths)
    for j, p in enumerate(fit.sweep.parameters):
        variables[f"sweep_{p.name}"] = _of(p, "dataset", fit.sweep.theta[:, j])
    variables["sweep_t_s"] = variable("dataset", fit.sweep.shift, "s", "time shift")
    of_routes: dict[Route, str] = {"sweep": "best fit of the sweep", "en4dvar": "centre of the posterior"}
    for route, words in of_routes.items():
        variables[f"nrmse_{route}"] = variable("dataset", fit.nrmse(route), "1", f"NRMSE, {words}")
    words = "log-evidence, adaptive importance sampling"
    variables["log_evidence"] = variable("dataset", fit.log_evidence, "1", words)
    if fit.sampled:
        words, effective = "effective number of draws of the log-evidence", [draws.effective for draws in fit.sampled]
        variables["evidence_draws"] = variable("dataset", effective, "1", words)
    coords = {"dataset": Variable(("dataset",), np.array(fit.names, dtype=object), {"long_name": "data set"})}
    return Group(variables, coords)


def _population(population: Population) -> Group:
    variables: dict[str, Variable] = {}
    for j, term in enumerate(population.terms):
        p = term.parameter
        variables[f"mean_{p.name}"] = _of(p, "draw", population.posterior.mean[:, j])
        variables[f"spread_{p.name}"] = _of(p, "draw", population.posterior.between[:, j])
    judged = {
        "effective_draws": population.size,
        "effective_draws_hierarchy": population.effective[0],
        "effective_draws_data_sets": population.effective[1],
        "log_evidence": population.log_evidence,
        "forward_runs": population.forward_runs,
    }
    return Group(variables, attrs=judged)


def _of(p: Parameter, dims: str | tuple[str, ...], values: Array) -> Variable:
    return variable(dims, values, p.unit, p.label, display_units=p.display_unit)
