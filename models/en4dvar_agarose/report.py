"""One self-contained page, the tables in three formats, the figures as PDF and PNG, and a study as one netCDF file: a
group a gel and model with both routes, and a population's draws.
"""

from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from en4dvar.estimation.population import Population
from en4dvar.model.state import Array, Parameter
from en4dvar.plumbing.files import inside, write_text
from en4dvar.report.chart import COLUMN
from en4dvar.report.html import render
from en4dvar.report.svg import draw
from en4dvar.results.netcdf import Group, SealedBytes, Variable, to_bytes, variable
from en4dvar_agarose import paper, tables
from en4dvar_agarose.figures import all_figures
from en4dvar_agarose.fits import DECISIVE, HYPER, LEVELS, MISFIT, Fit, Study, probability, verdict
from en4dvar_agarose.paper import LABELS, NAMES, QUANTITIES, ROUTES, Route

Cells = Iterator[list[str]]
TABLES = tuple(f"table{number}.{suffix}" for number in (1, 2) for suffix in ("csv", "md", "tex"))
FILES = (  # of a study; ``*`` stands for any text
    *TABLES, "sets.csv", "study.yaml", "study.nc", "study.html", "figures/*.png", "figures/*.pdf",
    "checkpoints/*", "checkpoints/sweep_*/*",
)  # fmt: skip


def write_study(study: Study, directory: Path) -> Path:
    """Write everything; returns the page. Raises :class:`OutputError`."""
    for number, route in enumerate(ROUTES, 1):
        rows = tables.table(study, route)
        write_text(directory / f"table{number}.csv", tables.as_csv(study, rows, route))
        write_text(directory / f"table{number}.md", tables.as_text(study, rows, route, "md"))
        write_text(directory / f"table{number}.tex", tables.as_text(study, rows, route, "tex"))
    write_text(directory / "sets.csv", tables.per_set_csv(study))
    write_text(directory / "study.yaml", study.plan.text)
    study_netcdf(study).write(directory / "study.nc")
    note = " Synthetic twin, no measurement." if study.plan.synthetic else ""
    figures = [(name, f"{caption}{note}", chart) for name, caption, chart in all_figures(study)]
    page = render(
        "page.html.j2",
        "en4dvar_agarose",
        study=study,
        hyper=HYPER,
        decisive=DECISIVE,
        members=study.every_fit[0].analyses[0].settings.members,
        sets=sum(len(study.any_fit(gel).problems) for gel in study.fits),
        routes=ROUTES,
        scores=_scores(study),
        apparent={gel: told for gel in study.fits if (told := _apparent_modulus(study, gel))},
        tables=[(tables.TITLES[route], tables.table(study, route)) for route in ROUTES],
        sources=tables.sources(study),
        labels=LABELS,
        disagreements=tables.disagreements(study),
        spreads=tables.spread_notes(study),
        quantities=QUANTITIES,
        dfs=list(_dfs(study)),
        narrow=list(_narrow(study)),
        coverage=_coverage(study),
        population=list(_population(study)),
        comparison=_comparison(study),
        judged=_judged(study),
        figures=draw(figures, folder=inside(directory, "figures")),
        wide=[name for name, _, chart in figures if chart.width > 1.5 * COLUMN],
    )
    return write_text(directory / "study.html", page)


def _scores(study: Study) -> dict[Route, dict[str, Array]]:
    """NRMSE of all data sets by route and model."""
    each = {route: {m: [f.nrmse(route) for f in study.every_fit if f.model == m] for m in NAMES} for route in ROUTES}
    return {r: {LABELS[m]: np.concatenate(v) for m, v in of.items() if v} for r, of in each.items()}


def _apparent_modulus(study: Study, gel: str) -> tuple[float, float] | None:
    """Correlation of ln G of the neo-Hookean law with that of the true G α / R₀, and its std; needs the truth and fits
    of that law.
    """
    true = {name: study.true_values(gel, name) for name in ("G", "alpha", "R0")}
    if "nh" not in study.fits[gel] or len(true["G"]) < 3:
        return None
    sheet = np.log(true["G"] * true["alpha"] / true["R0"])
    known = [name in study.truth for name in study.any_fit(gel).names]
    apparent = np.log(study.fits[gel]["nh"].values("en4dvar", "G")[known])
    return float(np.corrcoef(sheet, apparent)[0, 1]), float(apparent.std())


def _dfs(study: Study) -> Cells:
    for fit in study.every_fit:
        mean = fit.dfs()
        shares = [f"{100 * mean[q.name]:.0f} %" if q.name in mean else "–" for q in QUANTITIES]
        yield [fit.gel, LABELS[fit.model], *shares]


def _narrow(study: Study) -> Cells:
    for gel, narrow in study.narrow.items():
        for words, fit in (("of this study", study.fits[gel]["qlkv"]), ("as narrow as the printed spread", narrow)):
            j = fit.prior.names.index("R0")
            guess, spread = (np.exp(fit.prior.mean[j]) * 1e6, fit.prior.std[j])
            mean, std = (1e6 * v for v in fit.summary("en4dvar", "R0"))
            printed = tables.plus_minus(paper.TABLES["en4dvar"][gel]["qlkv"]["R0"])
            prior, dfs = f"{guess:.3g} µm, ± {100 * spread:.0f} %", f"{100 * fit.dfs()['R0']:.0f} %"
            estimates, lowest = tables.plus_minus((mean, std)), f"{fit.nrmse('en4dvar').min():.3f}"
            yield [gel, words, prior, estimates, printed, dfs, lowest]


def _coverage(study: Study) -> list[list[str]]:
    def share(fit: Fit, name: str) -> str:
        return f"{100 * study.coverage(fit.gel, fit.model, name):.0f} %" if fit.estimated(name) else "–"

    general = [fit for fit in study.every_fit if study.truth and fit.model == "qlkv"]
    return [[fit.gel, *(share(fit, q.name) for q in QUANTITIES)] for fit in general]


def _population(study: Study) -> Cells:
    for gel, distribution in study.populations.items():
        fit = study.fits[gel]["qlkv"]
        for q in (q for q in QUANTITIES if q.name in distribution.names):
            j = distribution.names.index(q.name)
            stacked, truth = fit.members(q.name) * q.factor, study.true_values(gel, q.name) * q.factor
            low, mean, high = np.quantile(distribution.posterior.mean[:, j], LEVELS) * q.factor
            std = np.median(distribution.posterior.between[:, j]) * q.factor
            known = tables.plus_minus((truth.mean(), truth.std(ddof=1))) if len(truth) > 1 else "–"
            cells = [f"{mean:.3g} [{low:.3g}, {high:.3g}]", f"{std:.2g}"]
            yield [gel, f"{q.plain} ({q.unit})", *cells, tables.plus_minus((stacked.mean(), stacked.std())), known]


def _comparison(study: Study) -> list[list[str]]:
    rows = []
    for gel, comparison in study.comparisons.items():
        compared = [*zip(study.fits[gel]["qlkv"].names, comparison.single, strict=True)]
        compared += [("all sets, a gel each", comparison.independent)]
        compared += [("all sets, one population", comparison.population), ("all sets, one gel", comparison.shared)]
        for words, value in compared:
            rows.append([gel, words, f"{value:+.1f}", f"{float(probability(np.array(value))):.2f}", verdict(value)])
        nh, quadratic = comparison.chi2
        reasons = [f"its evidence is in doubt ({', '.join(comparison.doubts)})"] if comparison.doubts else []
        if min(nh, quadratic) > MISFIT:
            reasons.append(f"no single gel fits (χ² per reading {nh:.1f} and {quadratic:.1f})")
        if reasons:
            rows[-1][-1] = f"no verdict: {'; '.join(reasons)}"
    return rows


def _judged(study: Study) -> dict[str, Any]:
    """Reliability of the evidences of single sets, and how many of them decide."""
    fits = [study.fits[gel][model] for gel in study.comparisons for model in ("nh", "qlkv")]
    return {
        "fewest": min((draws.effective for fit in fits for draws in fit.sampled), default=0.0),
        "laplace": max((float(np.max(np.abs(fit.laplace_evidence - fit.log_evidence))) for fit in fits), default=0.0),
        "undecided": sum(c.undecidable for c in study.comparisons.values()),
        "total": sum(len(c.single) for c in study.comparisons.values()),
    }


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
            groups[f"/{name}/population"] = _draws(study.populations[gel])
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


def _draws(population: Population) -> Group:
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
