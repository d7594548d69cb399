"""One self-contained page, the tables in three formats, the figures as PDF and PNG."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from en4dvar.errors import OutputError
from en4dvar.population import HyperPrior
from en4dvar.report.style import COLUMN, DARK, LIGHT, css_variables, inline_svg, save_figure
from en4dvar.storage.files import write_bytes, write_text
from en4dvar_agarose import measured, tables
from en4dvar_agarose.evidence import DECISIVE, MISFIT, probability, verdict
from en4dvar_agarose.figures import all_figures
from en4dvar_agarose.fits import Study
from en4dvar_agarose.paper import LABELS, NAMES, QUANTITIES, ROUTES, Route
from en4dvar_agarose.store import study_netcdf

ROUTE_KEYS: tuple[Route, ...] = ("sweep", "en4dvar")
Block = dict[str, Any]


def write_study(study: Study, directory: Path) -> Path:
    """Write everything; returns the page. Raises :class:`OutputError`."""
    figures_folder = directory / "figures"
    try:
        figures_folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{figures_folder}: cannot be created: {error.strerror or error}") from None
    for number, route in enumerate(ROUTE_KEYS, 1):
        rows = tables.table(study, route)
        write_text(directory / f"table{number}.csv", tables.as_csv(study, rows, route))
        write_text(directory / f"table{number}.md", tables.as_markdown(study, rows, route))
        write_text(directory / f"table{number}.tex", tables.as_latex(study, rows, route))
    write_text(directory / "sets.csv", tables.per_set_csv(study))
    write_text(directory / "study.yaml", study.plan.text)
    write_bytes(directory / "study.nc", study_netcdf(study))
    drawn = []
    for name, caption, figure in all_figures(study):
        save_figure(figure, figures_folder, name)
        wide = figure.get_size_inches()[0] > 1.5 * COLUMN
        drawn.append((name, caption, Markup(inline_svg(figure, name, caption)), wide))
    return write_text(directory / "study.html", _page(study, drawn))


def _page(study: Study, drawn: list[tuple[str, str, Markup, bool]]) -> str:
    environment = Environment(
        loader=PackageLoader("en4dvar_agarose", "."), autoescape=True, undefined=StrictUndefined, trim_blocks=True
    )
    plan = study.plan
    sets = sum(len(next(iter(models.values())).problems) for models in study.fits.values())
    differ = tables.disagreements(study)
    spreads = tables.spread_notes(study)
    return environment.get_template("page.html.j2").render(
        title=f"Acoustic cavitation rheometry: {plan.name}" + (" (synthetic twin)" if plan.synthetic else ""),
        synthetic=plan.synthetic,
        introduction=f"{sets} data sets in {len(study.fits)} gels; neo-Hookean, quasi-static and general quadratic law "
        "Kelvin–Voigt models; after Mancia et al. (2021), Acoustic Cavitation Rheometry.",
        findings=findings(study),
        tables=[_table(study, route) for route in ROUTE_KEYS],
        differ="Means that differ by more than both standard deviations together:"
        if differ
        else "No mean differs from the printed one by more than both standard deviations together.",
        disagreements=differ,
        spreads="Standard deviations at least two times larger or smaller than printed: " + "; ".join(spreads) + ". "
        "The spread over best fits depends on the ranges searched, which the paper does not state; the spread of "
        "En4D-Var estimates on the standard deviation of the prior, which it does not state either."
        if spreads
        else "",
        more=[b for b in _blocks(study) if b["rows"]],
        figures=drawn,
        method=_method(study),
        configuration=plan.text,
        light=Markup(css_variables(LIGHT)),
        dark=Markup(css_variables(DARK)),
    )


def _blocks(study: Study) -> tuple[Block, ...]:
    found = (_dfs(study), _narrow(study), _coverage(study), _population(study), _comparison(study))
    return (*found, _campaigns(), _reliability()) if study.plan.synthetic else found


def _campaigns() -> Block:
    return {
        "title": "The population estimate, repeated",
        "words": "Campaigns drawn anew from the distributions of the twin: how often the 95 % interval of the "
        "population mean holds the mean of the lognormal that the truths were drawn from, and the mean of the truths "
        "drawn. Measured once (python benchmarks/study_population.py) and shipped with the package; not computed by "
        "this study.",
        "heads": ["gel", "parameter", "distribution's mean", "share ± binomial std", "mean of the truths", "campaigns"],
        "rows": [
            [
                c.gel,
                c.parameter,
                *map(str, (c.held, f"{c.held / c.campaigns:.2f} ± {c.error:.2f}", c.of_drawn, c.campaigns)),
            ]
            for c in measured.coverage()
        ],
    }


def _reliability() -> Block:
    rows = []
    for name, words in measured.EXPERIMENTS.items():
        difference, quadratic = measured.reliability(name)
        right = np.mean((difference > 0) == quadratic)
        rows.append([words, "all", f"{right:.3f}", str(len(difference)), "–"])
        for b in measured.bins(difference, quadratic):
            rows.append([words, f"{b.stated:.3f}", f"{b.right:.3f}", str(b.count), f"{b.error:.3f}"])
    return {
        "title": "Are the probabilities of the laws right?",
        "words": "Experiments of one bubble, half drawn from each law's prior, compared by their evidence: "
        "stated probability of the favoured law and how often it was the right one. The second experiment decides. "
        "Measured once (python benchmarks/study_reliability.py) and shipped with the package; not computed by this "
        "study.",
        "heads": ["experiment", "stated", "right", "experiments", "binomial std"],
        "rows": rows,
    }


def _method(study: Study) -> str:
    s, seconds = study.plan.sweep, study.seconds
    members = next(iter(next(iter(study.fits.values())).values())).analyses[0].settings.members
    sweep = (
        f"{s.trajectories} trajectories a model, of one Sobol design for all data sets (quasi-static: for those with "
        "the same G), uniform in the transformed parameters; each set is searched within "
        f"{s.width:g} prior standard deviations, then {s.rounds} rounds of refinement with {s.local} a set; "
        f"nearest neighbour in time on a grid of {s.step * 1e6:g} µs, time shift within ±{s.shift * 1e6:g} µs; "
        "weights are the NRMSE of the best fits"
    )
    return (
        f"Sweep ({seconds['sweep']:.0f} s): {sweep}. En4D-Var ({seconds['en4dvar']:.0f} s): {members} members a set. "
        f"Population and comparison: {seconds['population']:.0f} s."
    )


def findings(study: Study) -> list[str]:
    """The paper's qualitative findings, in numbers of this study."""
    told = []
    for gel, models in study.fits.items():
        for route in ROUTE_KEYS:
            if {"nh", "qlkv"} <= set(models):
                nh, general = (models[m].summary(route, "G")[0] for m in ("nh", "qlkv"))
                mu = {m: models[m].summary(route, "mu")[0] for m in models}
                viscosities = ", ".join(f"{LABELS[m]} {v:.3f}" for m, v in mu.items())
                told.append(
                    f"{gel}, {ROUTES[route]}: G of the neo-Hookean law is {nh / general:.1f} times that of the general "
                    f"quadratic law; μ hardly depends on the model ({viscosities} Pa s)."
                )
    told += [told_of for gel in study.fits if (told_of := _apparent_modulus(study, gel))]
    for route in ROUTE_KEYS:
        used = [m for m in NAMES if any(m in models for models in study.fits.values())]
        scores = {m: np.concatenate([f[m].nrmse(route) for f in study.fits.values() if m in f]) for m in used}
        words = ", ".join(f"{LABELS[m]} {v.min():.3f} to {v.max():.3f}, mean {v.mean():.3f}" for m, v in scores.items())
        told.append(f"NRMSE, {ROUTES[route]}: {words}.")
    return told


def _apparent_modulus(study: Study, gel: str) -> str:
    """Why G of the neo-Hookean law scatters; needs the truth and the neo-Hookean fits."""
    true = {name: study.true_values(gel, name) for name in ("G", "alpha", "R0")}
    if "nh" not in study.fits[gel] or len(true["G"]) < 3:
        return ""
    sheet = np.log(true["G"] * true["alpha"] / true["R0"])
    apparent = np.log(study.fits[gel]["nh"].values("en4dvar", "G"))
    return (
        f"{gel}: G of the neo-Hookean law stands for the stiffening it lacks: from bubble to bubble its logarithm "
        f"follows that of the true G α / R₀ (correlation {np.corrcoef(sheet, apparent)[0, 1]:.2f}), so it scatters as "
        f"α and R₀ do, by ± {apparent.std():.2f} in ln G."
    )


def _table(study: Study, route: Route) -> Block:
    heads = tables.columns(study)
    return {
        "title": tables.TITLES[route],
        "legend": "; ".join(words for _, words in heads),
        "heads": [f"{q.plain} ({q.unit})" for q in QUANTITIES],
        "rows": [
            {
                "gel": row.gel,
                "model": LABELS[row.model],
                "cells": [[tables.text(cell, getattr(cell, a)) for a, _ in heads] for cell in row.cells],
            }
            for row in tables.table(study, route)
        ],
    }


def _dfs(study: Study) -> Block:
    rows = []
    for gel, models in study.fits.items():
        for model, fit in models.items():
            mean = dict(zip(fit.prior.names, np.mean([a.dfs_per_parameter for a in fit.analyses], axis=0), strict=True))
            shares = [f"{100 * mean[q.name]:.0f} %" if q.name in mean else "–" for q in QUANTITIES]
            rows.append([gel, LABELS[model], *shares])
    return {
        "title": "What one data set tells",
        "words": "DFS a parameter, 1 − posterior variance / prior variance, mean over the sets: 0 % means that the "
        "posterior is the prior. Viscosity is measured; a parameter with a small share stays near its initial guess, "
        "whatever the guess is.",
        "heads": ["gel", "model", *(q.plain for q in QUANTITIES)],
        "rows": rows,
    }


def _narrow(study: Study) -> Block:
    rows = []
    for gel, narrow in study.narrow.items():
        for words, fit in (("of this study", study.fits[gel]["qlkv"]), ("as narrow as the printed spread", narrow)):
            j = fit.prior.names.index("R0")
            dfs = float(np.mean([a.dfs_per_parameter[j] for a in fit.analyses]))
            guess, spread = (np.exp(fit.prior.mean[j]) * 1e6, fit.prior.std[j])
            mean, std = (1e6 * v for v in fit.summary("en4dvar", "R0"))
            printed = tables.plus_minus(tables.TABLES["en4dvar"][gel]["qlkv"]["R0"])
            prior = f"{guess:.3g} µm, ± {100 * spread:.0f} %"
            cells = [tables.plus_minus((mean, std)), printed, f"{100 * dfs:.0f} %", f"{fit.nrmse('en4dvar').min():.3f}"]
            rows.append([gel, words, prior, *cells])
    return {
        "title": "Does R₀ stay at its initial guess?",
        "words": "The paper finds that En4D-Var hardly moves R₀ from its initial guess, and does not state the spread "
        "of its initial ensemble. Here it depends on that spread: with a prior as wide as R₀ varies from bubble to "
        "bubble the data move it; with one as narrow as the spread the paper prints they cannot (DFS near zero), and "
        "the fit is hardly worse. A small spread of estimates is then that of the prior, no measurement.",
        "heads": ["gel", "prior of R₀", "guess", "estimates (µm)", "paper (µm)", "DFS of R₀", "lowest NRMSE"],
        "rows": rows,
    }


def _coverage(study: Study) -> Block:
    rows = [
        [gel, *(f"{100 * study.coverage(gel, 'qlkv', q.name):.0f} %" for q in QUANTITIES)]
        for gel in study.fits
        if study.truth and "qlkv" in study.fits[gel]
    ]
    return {
        "title": "Coverage of the truth",
        "words": "Share of the data sets whose central 90 % posterior interval (En4D-Var, general QLKV) holds the "
        "truth.",
        "heads": ["gel", *(q.plain for q in QUANTITIES)],
        "rows": rows,
    }


def _population(study: Study) -> Block:
    rows = []
    for gel, found in study.populations.items():
        fit = study.fits[gel]["qlkv"]
        interval = found.interval()
        for q in QUANTITIES:
            j = found.names.index(q.name)
            stacked, truth = fit.members(q.name) * q.factor, study.true_values(gel, q.name) * q.factor
            mean, std = (np.median(values[:, j]) * q.factor for values in (found.mean, found.std))
            low, high = interval[:, j] * q.factor
            known = tables.plus_minus((truth.mean(), truth.std(ddof=1))) if len(truth) > 1 else "–"
            cells = [f"{mean:.3g} [{low:.3g}, {high:.3g}]", f"{std:.2g}"]
            rows.append(
                [gel, f"{q.plain} ({q.unit})", *cells, tables.plus_minus((stacked.mean(), stacked.std())), known]
            )
    judged = [
        f"{gel}: {f.size:.0f} effective draws (weights with emulators {f.weighed[0]:.0f}, with forward runs "
        f"{f.weighed[1]:.0f})" + ("" if f.converged else ", NOT CONVERGED: do not use")
        for gel, f in study.populations.items()
    ]
    hyper = HyperPrior()
    return {
        "title": "Population of bubbles",
        "words": "General QLKV. Stacking the ensembles, as the paper does, counts the prior once a data set and so "
        "inherits it. Here every set's likelihood enters as it is (forward runs, no Gaussian), and mean and "
        "between-bubble spread are estimated together. The logarithms' mean is a priori within "
        f"{hyper.mean_std:g} (one standard deviation) of the initial guess, their spread half-normal of scale "
        f"{hyper.spread:g}. The interval is wide where the data determine only a combination of parameters (at the "
        "stretch of these bubbles the elastic stress depends on little else than G α / R₀): there it is mostly this "
        f"hyperprior. {'; '.join(judged)}.",
        "heads": ["gel", "parameter", "mean [95 %]", "spread", "stacked mean ± std", "truths mean ± std"],
        "rows": rows,
    }


def _comparison(study: Study) -> Block:
    rows = []
    for gel, found in study.comparisons.items():
        fit = study.fits[gel]["qlkv"]
        rows += [
            [gel, name, f"{value:+.1f}", f"{float(probability(value)):.2f}", verdict(value)]
            for name, value in zip(fit.names, found.single, strict=True)
        ]
        misfit = f"no verdict: no single gel fits (χ² per reading {found.chi2[0]:.1f} and {found.chi2[1]:.1f})"
        pooled = (
            ("all sets, a gel each", found.independent, verdict(found.independent)),
            ("all sets, one population", found.population, verdict(found.population)),
            ("all sets, one gel", found.shared, misfit if min(found.chi2) > MISFIT else verdict(found.shared)),
        )
        for words, value, told in pooled:
            rows.append([gel, words, f"{value:+.1f}", f"{float(probability(np.array(value))):.2f}", told])
    fits = [study.fits[gel][model] for gel in study.comparisons for model in ("nh", "qlkv")]
    fewest = min(float(fit.evidence.effective.min()) for fit in fits if fit.evidence is not None)
    laplace = [np.array([a.log_evidence for a in fit.analyses]) - fit.log_evidence for fit in fits]
    undecided = sum(c.undecidable for c in study.comparisons.values())
    total = sum(len(c.single) for c in study.comparisons.values())
    return {
        "title": "Neo-Hookean or quadratic law",
        "words": "Log-evidence of the general quadratic over the neo-Hookean law and its probability at equal prior "
        f"odds. Undecidable (|Δ| < {DECISIVE:g}) by itself: {undecided} of {total} data sets. “One gel”: G, α and μ "
        "common to all bubbles, R₀ and t_s of each its own. “One population”: they (and R₀) vary from bubble to "
        "bubble about a common mean with a common spread; the number to quote. Evidences of single sets are by "
        f"adaptive importance sampling with forward runs (at least {fewest:.0f} effective draws); Laplace's "
        f"approximation is off by up to {np.max(np.abs(np.concatenate(laplace))):.1f} here.",
        "heads": ["gel", "data set", "Δ log-evidence", "probability", "verdict"],
        "rows": rows,
    }
