"""The figures of the paper that are computed, drawn anew from a :class:`~en4dvar_agarose.fits.Study`."""

from collections.abc import Iterable, Iterator
from itertools import cycle

import numpy as np

from en4dvar.model.state import Array
from en4dvar.report.chart import COLUMN, PAGE, Chart, Panel, Row, in_columns
from en4dvar.report.svg import Captioned
from en4dvar_agarose.fits import DECISIVE, LEVELS, Fit, Study
from en4dvar_agarose.paper import NAMES, QUANTITIES, Quantity, Route
from en4dvar_agarose.settings import named
from en4dvar_bubble.model import BubbleModel

# line styles tell the same as colours, for print without colour
MODEL_COLOURS = {"nh": "centre", "qs": "background", "qlkv": "posterior"}
GEL_COLOURS = ("posterior", "centre", "background", "prior")
DASHES = ("", "--", ":", "")  # of the gels
ALONE = {"nh": "NH", "qs": "QS QLKV", "qlkv": "QLKV"}
R0_FIRST = (QUANTITIES[3], *QUANTITIES[:3])
FARTHEST = 30.0  # difference of log-evidences that the axis shows


def all_figures(study: Study) -> Iterator[Captioned]:
    count = "; ".join(f"{len(study.any_fit(gel).problems)} in {gel} gel" for gel in study.fits)
    yield "scaled", f"Scaled radius against time, R/R_max against t/t_c: {count}.", scaled_data(study)
    for fit in study.every_fit:
        caption = (
            f"Radius against time, {fit.gel} gel; line: best {NAMES[fit.model]} fit of the filled set (IMR sweep)."
        )
        yield f"dimensional_{named(fit.gel)}_{fit.model}", caption, dimensional(fit)
    routes: dict[Route, str] = {"sweep": "IMR sweep", "en4dvar": "En4D-Var, ensemble means"}
    for route, words in routes.items():
        caption = f"Distributions of shear modulus, stiffening, viscosity, stress-free radius; {words}."
        yield f"distributions_{route}", caption, distributions(study, route)
        yield f"nrmse_{route}", f"Distributions of NRMSE for the models; {words}.", nrmse_figure(study, route)
    for fit in (fit for fit in study.every_fit if fit.model == "qlkv"):
        members = len(fit.members(fit.prior.names[0]))
        caption = f"Combined final ensembles of all sets, {members} members; {fit.gel} gel, general QLKV."
        yield f"members_{named(fit.gel)}", caption, combined(study, fit)
        caption = (
            f"Iterative estimates from the initial guess (0) on, one line a data set; {fit.gel} gel, general QLKV."
        )
        yield f"iterations_{named(fit.gel)}", caption, iterations(fit)
    if study.populations:
        caption = "Population mean (95 % interval) by the hierarchical step and mean of the stacked ensembles"
        yield "population", f"{caption}{', with the truths' if study.truth else ''}.", population(study)
    if study.comparisons:
        caption = "Log-evidence of the quadratic over the neo-Hookean law; shaded: undecidable."
        yield "evidence", caption, evidence(study)


def collapse(times: Array, radius: Array) -> tuple[float, float, float]:
    """(R_max, t_max, t_c) of readings: the largest, by a parabola through it and its neighbours, and the time from
    there to the end of the first collapse, by the line through the last two readings.
    """
    top = int(np.argmax(radius))
    three = slice(max(top - 1, 0), top + 2)
    R_max, t_max = float(radius[top]), float(times[top])
    if three.stop - three.start == 3 and three.stop <= len(times):
        a, b, c = np.polyfit(times[three] - times[top], radius[three], 2)
        if a < 0:
            t_max, R_max = float(times[top] - b / (2 * a)), float(c - b * b / (4 * a))
    slope = (radius[-1] - radius[-2]) / (times[-1] - times[-2])
    t_end = float(times[-1] - radius[-1] / slope) if slope < 0 else float(times[-1])
    return R_max, t_max, t_end - t_max


def scaled_data(study: Study) -> Chart:
    """R/R_max against t/t_c, t from the start of the scaled history; open and filled markers for the gels."""
    panel = Panel(r"$(t - t_{\max})/t_c + 1$", r"$R/R_{\max}$", ylim=(0.0, 1.1), legend=True)
    for (number, gel), colour in zip(enumerate(study.fits), cycle(GEL_COLOURS)):
        for problem in study.any_fit(gel).problems:
            o = problem.observations
            R_max, t_max, t_c = collapse(o.times, o.values)
            x, y = (o.times - t_max) / t_c + 1, o.values / R_max
            panel.dots(x, y, colour, 3.0, 0.8, f"{gel} gel", kind="dots" if number else "rings")
    return Chart([Row(0.72 * COLUMN, [panel])])


def dimensional(fit: Fit) -> Chart:
    """All readings; the set of median NRMSE filled, with its best fit of the sweep."""
    chosen = int(np.argsort(fit.sweep.nrmse)[len(fit.sweep.nrmse) // 2])
    values = {p.name: fit.sweep.theta[chosen, j] for j, p in enumerate(fit.sweep.parameters)}
    units = {q.name: "× 10⁻²" if q.unit == "10⁻²" else q.unit for q in QUANTITIES if q.name in values}
    numbers = [f"{q.latex} = {values[q.name] * q.factor:.3g} {units[q.name]}" for q in QUANTITIES if q.name in units]
    title = ",\n".join(map(", ".join, (numbers[:2], [*numbers[2:], f"NRMSE = {fit.sweep.nrmse[chosen]:.3f}"])))
    panel = Panel("time (µs)", "radius (µm)", title=title)
    for i, problem in enumerate(fit.problems):
        o = problem.observations
        if i != chosen:
            panel.dots(o.times * 1e6, o.values * 1e6, "prior", 2.6, kind="rings")
    o = fit.problems[chosen].observations
    grid = np.linspace(max(0.0, o.times[0] - 2e-6), o.times[-1] + 1e-6, 400)
    panel.line(grid * 1e6, _trace(fit, chosen, grid) * 1e6, "ink", 1.2)
    panel.dots(o.times * 1e6, o.values * 1e6, "posterior", 3.6)
    panel.ylim = 0.0, panel.limits()[1][1]
    return Chart([Row(0.72 * COLUMN, [panel])])


def _trace(fit: Fit, chosen: int, grid: Array) -> Array:
    problem = fit.problems[chosen]
    model = problem.model
    assert isinstance(model, BubbleModel)
    theta = {p.name: float(v) for p, v in zip(fit.sweep.parameters, fit.sweep.theta[chosen], strict=True)}
    state = model.initial_state({**{k: v for k, v in problem.fixed.items() if k != "t_s"}, **theta})
    at = grid + fit.sweep.shift[chosen]
    return np.asarray(model.integrate(state[None], np.maximum(at, 0.0)[None])["R"][0])


def _label(q: Quantity) -> str:
    return f"{q.latex} ({q.unit})"


def _steps(values: Iterable[Array], factors: tuple[float, ...] = (1, 2, 5), every: int = 1) -> list[float]:
    """Multiples of powers of ten among values, for a logarithmic axis."""
    held = np.concatenate([np.ravel(v) for v in values])
    low, high = held.min() * 0.95, held.max() * 1.05
    return [t * 10.0**e for e in range(-4, 5) for t in factors if low <= t * 10.0**e <= high][::every]


def distributions(study: Study, route: Route) -> Chart:
    """G, α, μ and R0 of the neo-Hookean and general quadratic laws in every gel."""
    panels = []
    for q, letter in zip(QUANTITIES, "abcd", strict=True):
        panel = Panel(_label(q), "density per unit of ln" if letter in "ac" else "", title=f"({letter})")
        panel.x_logarithmic, panel.legend = True, letter == "a"
        held = []
        for gel, dash in zip(study.fits, cycle(DASHES)):
            for model in ("nh", "qlkv"):
                fit = study.fits[gel].get(model)
                if fit is not None and fit.estimated(q.name):
                    held.append(fit.values(route, q.name) * q.factor)
                    _density(panel, held[-1], MODEL_COLOURS[model], dash, f"{ALONE[model]}, {gel}")
        if held:
            panel.xticks = _steps(held, every=2 if max(map(np.max, held)) / min(map(np.min, held)) > 30 else 1)
        panels.append(panel)
    return in_columns(panels, 0.3 * PAGE, width=PAGE)


def _density(panel: Panel, values: Array, colour: str, dash: str, label: str) -> None:
    """Smoothed density in ln θ, on a logarithmic axis; its area in ln θ is one."""
    logs = np.log(values)
    width = max(1.06 * logs.std(ddof=min(1, len(logs) - 1)) * len(logs) ** -0.2, 0.02)
    grid = np.linspace(logs.min() - 3 * width, logs.max() + 3 * width, 300)
    z = (grid[:, None] - logs) / width
    density = np.exp(-0.5 * z * z).sum(axis=1) / (len(logs) * width * np.sqrt(2 * np.pi))
    panel.line(np.exp(grid), density, colour, dash=dash, label=label)
    panel.dots(values, np.full(len(values), -0.06 * density.max()), colour, 3.0, kind="ticks")


def nrmse_figure(study: Study, route: Route) -> Chart:
    """Histograms of NRMSE, a panel a model, gels by colour and line style."""
    models = list(dict.fromkeys(fit.model for fit in study.every_fit))
    every = np.concatenate([fit.nrmse(route) for fit in study.every_fit])
    edges = np.linspace(min(0.9, np.floor(every.min() * 100) / 100), 1.0, 21)
    panels: list[Panel] = []
    for model, letter in zip(models, "abc", strict=False):
        panel = Panel("NRMSE", "" if panels else "data sets", title=f"({letter}) {NAMES[model]}", legend=True)
        for gel, colour, dash in zip(study.fits, cycle(GEL_COLOURS), cycle(DASHES)):
            fit = study.fits[gel].get(model)
            if fit is not None:
                counts, label = np.histogram(fit.nrmse(route), edges)[0], f"{gel}: mean {fit.nrmse(route).mean():.3f}"
                panel.stairs(edges, counts, colour, 0.4, 1.0, dash, label)
        panels.append(panel)
    return Chart([Row(0.3 * PAGE, panels)], PAGE)


def combined(study: Study, fit: Fit) -> Chart:
    """Histograms of all posterior members with prior, mean and (twin) the truths."""
    panels: list[Panel] = []
    for q in (q for q in R0_FIRST if fit.estimated(q.name)):
        values, prior = fit.members(q.name) * q.factor, fit.prior_members(q.name) * q.factor
        low, high = map(float, np.quantile(values, (0.001, 0.999)))
        edges = np.linspace(low, high, 31)
        panel = Panel(_label(q), yticks=(), left=False, legend=not panels)
        panel.stairs(edges, _heights(values, edges), "posterior", 0.75, label="members")
        panel.stairs(edges[::3], _heights(prior, edges[::3]), "prior", 0.0, 1.0, label="prior")
        top = panel.limits()[1][1]
        panel.line(np.full(2, values.mean()), [0, top], "ink", 1.0, label="mean")
        truth = study.true_values(fit.gel, q.name) * q.factor
        if len(truth):
            panel.dots(truth, np.full(len(truth), 0.04 * top), "centre", 6.0, label="truths", kind="ticks")
        panel.ylim = 0.0, top
        panels.append(panel)
    return in_columns(panels, 0.43 * COLUMN, width=COLUMN)


def _heights(values: Array, edges: Array) -> Array:
    """Density of values between the edges; where some lie beyond these the area is less than one."""
    return np.histogram(values, edges)[0] / (len(values) * np.diff(edges))


def iterations(fit: Fit) -> Chart:
    """Estimates of every data set against the iteration, from the prior mean on."""
    panels = []
    for q in (q for q in R0_FIRST if fit.estimated(q.name)):
        j = fit.prior.names.index(q.name)
        guess = float(np.exp(fit.prior.mean[j])) * q.factor
        panel = Panel("iteration", _label(q), whole=True)
        for analysis in fit.analyses:
            path = [guess, *(record.centre[j] * q.factor for record in analysis.iterations)]
            panel.line(np.arange(len(path)), path, "posterior", 0.6, alpha=0.7)
            panel.dots([len(path) - 1], path[-1:], "posterior", 1.6)
        panel.rule(guess, "centre", 0.8)
        panels.append(panel)
    return in_columns(panels, 0.43 * COLUMN, width=COLUMN)


def population(study: Study) -> Chart:
    """Hierarchical population mean with interval, stacked mean, mean of the truths; relative to the initial guess."""
    gels = list(study.populations)
    panels: list[Panel] = []
    for q in QUANTITIES:
        of_gels = [(row, *gel) for row, gel in enumerate(study.populations.items()) if q.name in gel[1].names]
        if not of_gels:
            continue
        panel = Panel(_label(q), x_logarithmic=True, legend=not panels, ylim=(-0.6, len(gels) - 0.4))
        panel.yticks, panel.y_names = range(len(gels)), gels if not panels else [""] * len(gels)
        for row, gel, distribution in of_gels:
            j, fit = distribution.names.index(q.name), study.fits[gel]["qlkv"]
            low, middle, high = np.quantile(distribution.posterior.mean[:, j], LEVELS) * q.factor
            panel.intervals([low], [high], [row], "posterior", 1.5)
            panel.dots([middle], [row], "posterior", 4.0, label="hierarchical")
            panel.dots([fit.members(q.name).mean() * q.factor], [row + 0.18], "prior", 4.0, label="stacked")
            truth = study.true_values(gel, q.name) * q.factor
            if len(truth):
                label = "mean of the truths"
                panel.dots([truth.mean()], [row - 0.18], "centre", 5.0, label=label, kind="rings")
        held = [mark.x[np.isfinite(mark.x)] for mark in panel.marks]
        wide = max(map(np.max, held)) > 4 * min(map(np.min, held))
        panel.xticks = _steps(held, (1, 2, 5) if wide else (1, 1.5, 2, 3, 5, 7))
        panels.append(panel)
    return Chart([Row(0.3 * PAGE, panels)], PAGE)


def evidence(study: Study) -> Chart:
    """Δ log-evidence of every data set, the undecidable band shaded; what lies beyond the axis stands at its end."""
    gels = list(study.comparisons)
    reach = min(FARTHEST, max(4.0, *(1.1 * np.max(np.abs(c.single)) for c in study.comparisons.values())))
    panel = Panel("Δ log-evidence (neo-Hookean ← 0 → quadratic)", xlim=(-reach, reach), legend=True)
    panel.ylim, panel.yticks, panel.y_names = (-0.5, len(gels) - 0.5), range(len(gels)), [f"{gel} gel" for gel in gels]
    panel.band([-DECISIVE, DECISIVE], [-0.5, -0.5], np.full(2, len(gels) - 0.5), "grid", 1.0)
    panel.line([0, 0], [-0.5, len(gels) - 0.5], "muted", 0.6)
    for (row, comparison), colour in zip(enumerate(study.comparisons.values()), cycle(GEL_COLOURS)):
        height = row + np.linspace(-0.25, 0.25, len(comparison.single))
        inside = np.abs(comparison.single) <= FARTHEST
        panel.dots(comparison.single[inside], height[inside], colour, 3.2)
        beyond = comparison.single[~inside]
        if len(beyond):
            words = f"beyond: {', '.join(f'{value:.0f}' for value in beyond)}"
            panel.dots(0.98 * reach * np.sign(beyond), height[~inside], colour, 4.5, label=words, kind="rings")
    return Chart([Row(0.6 * COLUMN, [panel])])
