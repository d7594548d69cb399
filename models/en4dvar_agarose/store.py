"""A study as one netCDF file: a group a gel and model with both routes, and a population's draws."""

from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Any

import numpy as np

from en4dvar.estimation.population import Population
from en4dvar.model.state import Parameter
from en4dvar.results.netcdf import Group, Variable, to_bytes
from en4dvar.results.seal import SealedBytes
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
        about = _words(p)
        variables[p.name] = Variable(("dataset", "draw"), np.stack([a.posterior[:, j] for a in fit.analyses]), about)
        variables[f"dfs_{p.name}"] = _plain(
            np.array([a.dfs_per_parameter[j] for a in fit.analyses]), f"DFS of {p.name}"
        )
        truths = np.array([study.truth.get(name, {}).get(p.name, np.nan) for name in fit.names])
        if study.truth and np.isfinite(truths).any():
            variables[f"truth_{p.name}"] = Variable(("dataset",), truths, about)
    for j, p in enumerate(fit.sweep.parameters):
        variables[f"sweep_{p.name}"] = Variable(("dataset",), fit.sweep.theta[:, j], _words(p))
    variables["sweep_t_s"] = Variable(("dataset",), fit.sweep.shift, {"units": "s", "long_name": "time shift"})
    of_routes: dict[Route, str] = {"sweep": "best fit of the sweep", "en4dvar": "centre of the posterior"}
    for route, words in of_routes.items():
        variables[f"nrmse_{route}"] = _plain(fit.nrmse(route), f"NRMSE, {words}")
    variables["log_evidence"] = _plain(fit.log_evidence, "log-evidence, adaptive importance sampling")
    if fit.sampled:
        effective = np.array([draws.effective for draws in fit.sampled])
        variables["evidence_draws"] = _plain(effective, "effective number of draws of the log-evidence")
    coords = {"dataset": Variable(("dataset",), np.array(fit.names, dtype=object), {"long_name": "data set"})}
    return Group(variables, coords)


def _population(population: Population) -> Group:
    variables: dict[str, Variable] = {}
    for j, term in enumerate(population.terms):
        name, about = term.parameter.name, _words(term.parameter)
        variables[f"mean_{name}"] = Variable(("draw",), population.posterior.mean[:, j], about)
        variables[f"spread_{name}"] = Variable(("draw",), population.posterior.between[:, j], about)
    judged = {
        "effective_draws": population.size,
        "effective_draws_hierarchy": population.effective[0],
        "effective_draws_data_sets": population.effective[1],
        "log_evidence": population.log_evidence,
        "forward_runs": population.forward_runs,
    }
    return Group(variables, attrs=judged)


def _words(p: Parameter) -> Mapping[str, Any]:
    return {"units": p.unit, "long_name": p.label, "display_units": p.display_unit}


def _plain(values: np.ndarray[Any, Any], words: str) -> Variable:
    return Variable(("dataset",), values, {"units": "1", "long_name": words})
