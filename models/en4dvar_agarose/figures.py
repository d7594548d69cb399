"""The figures of the paper that are computed, drawn anew from a :class:`~en4dvar_agarose.fits.Study`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from en4dvar.report.style import COLUMN, LIGHT, PAGE, styled
from en4dvar.state import Array
from en4dvar_agarose import measured
from en4dvar_agarose.fits import Fit, Study
from en4dvar_agarose.paper import NAMES, QUANTITIES, Quantity, Route
from en4dvar_bubble.model import BubbleModel

# Okabe & Ito; line styles and hatches tell the same, for print without colour
MODEL_COLOURS = {"nh": "#d55e00", "qs": "#009e73", "qlkv": "#0072b2"}
GEL_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#85858f")
ALONE = {"nh": "NH", "qs": "QS QLKV", "qlkv": "QLKV"}
R0_FIRST = (QUANTITIES[3], *QUANTITIES[:3])
FARTHEST = 30.0  # difference of log-evidences that the axis shows


@dataclass(frozen=True)
class Drawn:
    """A figure, the name of its files, and its caption."""

    name: str
    caption: str
    figure: Figure


def all_figures(study: Study) -> Iterator[Drawn]:
    """Every figure; captions say where data are synthetic."""
    note = " Synthetic twin, no measurement." if study.plan.synthetic else ""
    for drawn in _figures(study):
        yield replace(drawn, caption=drawn.caption + note)


def _figures(study: Study) -> Iterator[Drawn]:
    count = "; ".join(f"{len(study.any_fit(gel).problems)} in {gel} gel" for gel in study.fits)
    yield Drawn("scaled", f"Scaled radius against time, R/R_max against t/t_c: {count}.", scaled_data(study))
    for gel, models in study.fits.items():
        for model, fit in models.items():
            caption = f"Radius against time, {gel} gel; line: best {NAMES[model]} fit of the filled set (IMR sweep)."
            yield Drawn(f"dimensional_{gel_key(gel)}_{model}", caption, dimensional(fit))
    routes: dict[Route, str] = {"sweep": "IMR sweep", "en4dvar": "En4D-Var, ensemble means"}
    for route, words in routes.items():
        caption = f"Distributions of shear modulus (inset: stiffening), viscosity, stress-free radius; {words}."
        yield Drawn(f"distributions_{route}", caption, distributions(study, route))
        yield Drawn(f"nrmse_{route}", f"Distributions of NRMSE for the models; {words}.", nrmse_figure(study, route))
    for gel, fit in ((gel, models["qlkv"]) for gel, models in study.fits.items() if "qlkv" in models):
        members = len(fit.members("mu"))
        caption = f"Combined final ensembles of all sets, {members} members; {gel} gel, general QLKV."
        yield Drawn(f"members_{gel_key(gel)}", caption, combined(study, fit))
        caption = f"Iterative estimates, one line a data set; {gel} gel, general QLKV."
        yield Drawn(f"iterations_{gel_key(gel)}", caption, iterations(fit))
    if study.populations:
        caption = "Population mean (95 % interval) by the hierarchical step and mean of the stacked ensembles"
        yield Drawn("population", f"{caption}{', with the truths' if study.truth else ''}.", population(study))
    if study.comparisons:
        caption = "Log-evidence of the quadratic over the neo-Hookean law; shaded: undecidable."
        yield Drawn("evidence", caption, evidence(study))
    if study.plan.synthetic:
        caption = "Stated probability of the favoured law against how often it was right; bars: binomial standard "
        caption += "deviation. Repeated synthetic experiments, half by each law."
        yield Drawn("reliability", caption, reliability_figure())


def gel_key(gel: str) -> str:
    """A gel's label as part of a file name."""
    return "".join(c if c.isalnum() else "_" for c in gel.replace("%", "")).strip("_")


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


@styled
def scaled_data(study: Study) -> Figure:
    """R/R_max against t/t_c, t from the start of the scaled history; open and filled markers for the gels."""
    figure = Figure(figsize=(COLUMN, 0.72 * COLUMN), layout="constrained")
    axes = figure.subplots()
    for number, gel in enumerate(study.fits):
        colour = GEL_COLOURS[number % len(GEL_COLOURS)]
        for i, problem in enumerate(study.any_fit(gel).problems):
            o = problem.observations
            R_max, t_max, t_c = collapse(o.times, o.values)
            marker, fill = ("o", "none") if number == 0 else ("s", colour)
            axes.plot(
                (o.times - t_max) / t_c + 1, o.values / R_max, marker, ms=3, mfc=fill, mec=colour, mew=0.6, alpha=0.8,
                label=f"{gel} gel" if i == 0 else None,
            )  # fmt: skip
    axes.set(xlabel=r"$(t - t_{\max})/t_c + 1$", ylabel=r"$R/R_{\max}$", ylim=(0, 1.1))
    axes.legend(loc="lower center")
    return figure


@styled
def dimensional(fit: Fit) -> Figure:
    """All readings; the set of median NRMSE filled, with its best fit of the sweep."""
    figure = Figure(figsize=(COLUMN, 0.72 * COLUMN), layout="constrained")
    axes = figure.subplots()
    chosen = int(np.argsort(fit.sweep.nrmse)[len(fit.sweep.nrmse) // 2])
    for i, problem in enumerate(fit.problems):
        o = problem.observations
        if i != chosen:
            axes.plot(o.times * 1e6, o.values * 1e6, "o", ms=2.6, mfc="none", mec=LIGHT["prior"], mew=0.5)
    o = fit.problems[chosen].observations
    grid = np.linspace(max(0.0, o.times[0] - 2e-6), o.times[-1] + 1e-6, 400)
    trace = _trace(fit, chosen, grid)
    axes.plot(grid * 1e6, trace * 1e6, color=LIGHT["ink"], lw=1.2, zorder=3)
    axes.plot(o.times * 1e6, o.values * 1e6, "s", ms=3.6, color=LIGHT["posterior"], zorder=4)
    values = {p.name: fit.sweep.theta[chosen, j] for j, p in enumerate(fit.sweep.parameters)}
    lines = [f"{q.latex} = {values[q.name] * q.factor:.3g} {_unit(q)}" for q in QUANTITIES if q.name in values]
    axes.text(
        0.5, 0.04, "\n".join([*lines, f"NRMSE = {fit.sweep.nrmse[chosen]:.3f}"]), transform=axes.transAxes,
        fontsize=6.5, ha="center", va="bottom",
    )  # fmt: skip
    axes.set(xlabel="time (µs)", ylabel="radius (µm)", ylim=(0, None))
    return figure


def _trace(fit: Fit, chosen: int, grid: Array) -> Array:
    problem = fit.problems[chosen]
    model = problem.model
    assert isinstance(model, BubbleModel)
    theta = {p.name: float(v) for p, v in zip(fit.sweep.parameters, fit.sweep.theta[chosen], strict=True)}
    state = model.initial_state({**{k: v for k, v in problem.fixed.items() if k != "t_s"}, **theta})
    at = grid + fit.sweep.shift[chosen]
    return np.asarray(model.integrate(state[None], np.maximum(at, 0.0)[None])["R"][0])


def _unit(q: Quantity) -> str:
    return {"10⁻²": r"$\times 10^{-2}$", "Pa s": "Pa s"}.get(q.unit, q.unit)


def _label(q: Quantity) -> str:
    return f"{q.latex} ({'$10^{-2}$' if q.unit == '10⁻²' else q.unit})"


def _density(axes: Axes, values: Array, colour: str, style: str, label: str | None) -> None:
    """Smoothed density in ln θ, on a logarithmic axis; its area in ln θ is one."""
    logs = np.log(values)
    width = max(1.06 * logs.std(ddof=1) * len(logs) ** -0.2, 0.02)
    grid = np.linspace(logs.min() - 3 * width, logs.max() + 3 * width, 300)
    z = (grid[:, None] - logs) / width
    density = np.exp(-0.5 * z * z).sum(axis=1) / (len(logs) * width * np.sqrt(2 * np.pi))
    axes.plot(np.exp(grid), density, style, color=colour, label=label)
    axes.plot(values, np.full(len(values), -0.06 * density.max()), "|", ms=3, mew=0.5, color=colour, clip_on=False)


@styled
def distributions(study: Study, route: Route) -> Figure:
    """(a) G with α as inset, (b) μ, (c) R0, of the neo-Hookean and general quadratic laws in every gel."""
    figure = Figure(figsize=(PAGE, 0.36 * PAGE), layout="constrained")
    panels = figure.subplots(1, 3)
    shown = [q for q in QUANTITIES if q.name != "alpha"]
    for panel, q, letter in zip(panels, shown, "abc", strict=True):
        _lines(panel, study, route, q, ("nh", "qlkv"), named=letter == "b")
        panel.set_title(f"({letter})", loc="left")
        panel.set_ylabel("density per unit of ln" if letter == "a" else "")
    panels[0].set_ylim(top=2.0 * panels[0].get_ylim()[1])
    inset = panels[0].inset_axes((0.56, 0.7, 0.42, 0.3))
    _lines(inset, study, route, QUANTITIES[1], ("qlkv",))
    inset.tick_params(labelsize=5.5)
    inset.set_xlabel(_label(QUANTITIES[1]), fontsize=6, labelpad=1)
    inset.set_yticks([])
    low, high = inset.get_xlim()
    ticks = (0.1, 0.3, 1, 3, 10, 30) if high / low > 10 else (0.5, 1, 2, 3, 5, 10, 20)
    inset.set_xticks([t for t in ticks if low <= t <= high])
    _legend_above(figure, panels[1], 4)
    return figure


def _lines(axes: Axes, study: Study, route: Route, q: Quantity, models: tuple[str, ...], named: bool = False) -> None:
    for gel, style in zip(study.fits, ("-", "--", ":", "-."), strict=False):
        for model in models:
            fit = study.fits[gel].get(model)  # type: ignore[call-overload]
            if fit is not None and fit.estimated(q.name):
                label = f"{ALONE[model]}, {gel}" if named else None
                _density(axes, fit.values(route, q.name) * q.factor, MODEL_COLOURS[model], style, label)
    axes.set_xlabel(_label(q))
    low, high = _logarithmic(axes)
    _ticks(axes, (1, 2, 5), every=2 if high / low > 30 else 1)


def _logarithmic(axes: Axes) -> tuple[float, float]:
    """Make the horizontal axis logarithmic; its limits."""
    axes.set_xscale("log")
    low, high = axes.get_xlim()
    return low, high


def _ticks(axes: Axes, steps: Sequence[float], every: int = 1) -> None:
    """Plain numbers at these multiples of powers of ten, on a logarithmic axis."""
    low, high = axes.get_xlim()
    axes.set_xticks([t * 10.0**e for e in range(-4, 5) for t in steps if low <= t * 10.0**e <= high][::every])
    axes.set_xticks([], minor=True)
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")


def _legend_above(figure: Figure, axes: Axes, columns: int, **options: Any) -> None:
    """What the axes' lines are, above all panels."""
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=columns, **options)


@styled
def nrmse_figure(study: Study, route: Route) -> Figure:
    """Histograms of NRMSE, a panel a model, gels by colour and hatch."""
    figure = Figure(figsize=(PAGE, 0.3 * PAGE), layout="constrained")
    models = list(dict.fromkeys(m for fits in study.fits.values() for m in fits))
    panels = np.atleast_1d(figure.subplots(1, len(models), sharex=True, sharey=True))
    every = np.concatenate([fit.nrmse(route) for fits in study.fits.values() for fit in fits.values()])
    edges = np.linspace(min(0.9, np.floor(every.min() * 100) / 100), 1.0, 21)
    for panel, model, letter in zip(panels, models, "abc", strict=False):
        for number, gel in enumerate(study.fits):
            fit = study.fits[gel].get(model)
            if fit is not None:
                panel.hist(
                    fit.nrmse(route), edges, histtype="stepfilled", alpha=0.45, color=GEL_COLOURS[number],
                    ec=GEL_COLOURS[number], hatch=("", "////")[number % 2], lw=1,
                    label=f"{gel}: mean {fit.nrmse(route).mean():.3f}",
                )  # fmt: skip
        panel.set_title(f"({letter}) {NAMES[model]}", loc="left")
        panel.set_xlabel("NRMSE")
        panel.legend(loc="upper left")
    panels[0].set_ylabel("data sets")
    return figure


@styled
def combined(study: Study, fit: Fit) -> Figure:
    """Histograms of all posterior members with prior, mean and (twin) the truths."""
    figure = Figure(figsize=(COLUMN, 0.85 * COLUMN), layout="constrained")
    for axes, q in zip(figure.subplots(2, 2).ravel(), R0_FIRST, strict=True):
        values = fit.members(q.name) * q.factor
        low, high = np.quantile(values, (0.001, 0.999))
        edges = np.linspace(float(low), float(high), 31)
        prior = fit.prior_members(q.name) * q.factor
        axes.hist(values, edges, color=LIGHT["posterior"], alpha=0.75, density=True, label="members")
        axes.hist(prior, edges[::3], histtype="step", color=LIGHT["prior"], density=True, lw=1, label="prior")
        axes.axvline(values.mean(), color=LIGHT["ink"], lw=1, label="mean")
        truth = study.true_values(fit.gel, q.name) * q.factor
        if len(truth):
            height = 0.04 * axes.get_ylim()[1]
            axes.plot(truth, np.full(len(truth), height), "|", color=LIGHT["centre"], ms=6, label="truths")
        axes.set_xlabel(_label(q))
        axes.set_yticks([])
    _legend_above(figure, axes, 4, columnspacing=1.2, handlelength=1.4)
    return figure


@styled
def iterations(fit: Fit) -> Figure:
    """Estimates of every data set against the iteration, from the prior mean on."""
    figure = Figure(figsize=(COLUMN, 0.85 * COLUMN), layout="constrained")
    for axes, q in zip(figure.subplots(2, 2, sharex=True).ravel(), R0_FIRST, strict=True):
        j = fit.prior.names.index(q.name)
        guess = float(np.exp(fit.prior.mean[j])) * q.factor
        for analysis in fit.analyses:
            path = [guess, *(record.centre[j] * q.factor for record in analysis.iterations)]
            axes.plot(range(len(path)), path, "-", lw=0.6, color=LIGHT["posterior"], alpha=0.7)
            axes.plot(len(path) - 1, path[-1], ".", ms=3, color=LIGHT["posterior"])
        axes.axhline(guess, color=LIGHT["centre"], lw=0.8, ls="--")
        axes.set_ylabel(_label(q))
    figure.supxlabel("iteration (0: initial guess)", fontsize=8)
    return figure


@styled
def population(study: Study) -> Figure:
    """Hierarchical population mean with interval, stacked mean, mean of the truths; relative to the initial guess."""
    figure = Figure(figsize=(PAGE, 0.3 * PAGE), layout="constrained")
    panels = figure.subplots(1, len(QUANTITIES))
    for panel, q in zip(panels, QUANTITIES, strict=True):
        for row, (gel, found) in enumerate(study.populations.items()):
            j, fit = found.names.index(q.name), study.fits[gel]["qlkv"]
            low, high = found.interval()[:, j] * q.factor
            middle = float(np.median(found.mean[:, j])) * q.factor
            panel.plot([low, high], [row, row], "-", color=LIGHT["posterior"], lw=1.5)
            panel.plot(middle, row, "o", color=LIGHT["posterior"], ms=4, label="hierarchical" if row == 0 else None)
            stacked = fit.members(q.name).mean() * q.factor
            panel.plot(stacked, row + 0.18, "D", color=LIGHT["prior"], ms=4, label="stacked" if row == 0 else None)
            truth = study.true_values(gel, q.name) * q.factor
            if len(truth):
                label = "mean of the truths" if row == 0 else None
                panel.plot(truth.mean(), row - 0.18, "*", color=LIGHT["centre"], ms=7, label=label)
        panel.set_yticks(range(len(study.populations)), list(study.populations) if panel is panels[0] else [])
        panel.set_ylim(-0.6, len(study.populations) - 0.4)
        panel.set_xlabel(_label(q))
        low, high = _logarithmic(panel)
        _ticks(panel, (1, 2, 5) if high / low > 4 else (1, 1.5, 2, 3, 5, 7))
    _legend_above(figure, panels[0], 3)
    return figure


@styled
def evidence(study: Study) -> Figure:
    """Δ log-evidence of every data set, the undecidable band shaded; beyond the axis a triangle with the value."""
    figure = Figure(figsize=(COLUMN, 0.6 * COLUMN), layout="constrained")
    axes = figure.subplots()
    axes.axvspan(-3, 3, color=LIGHT["grid"], zorder=0)
    axes.axvline(0, color=LIGHT["muted"], lw=0.6)
    for row, found in enumerate(study.comparisons.values()):
        height = row + np.linspace(-0.25, 0.25, len(found.single))
        inside = np.abs(found.single) <= FARTHEST
        axes.plot(found.single[inside], height[inside], "o" if row == 0 else "s", ms=3.2, color=GEL_COLOURS[row])
        for value, y in zip(found.single[~inside], height[~inside], strict=True):
            edge, marker, side = (FARTHEST, ">", "right") if value > 0 else (-FARTHEST, "<", "left")
            axes.plot(edge, y, marker, ms=4.5, color=GEL_COLOURS[row], clip_on=False)
            axes.annotate(
                f"{value:.0f}", (edge, y), (-5 if value > 0 else 5, 0), textcoords="offset points", fontsize=6, ha=side,
                va="center",
            )  # fmt: skip
    axes.set_yticks(range(len(study.comparisons)), [f"{gel} gel" for gel in study.comparisons])
    reach = min(FARTHEST, max(4.0, *(1.1 * np.max(np.abs(c.single)) for c in study.comparisons.values())))
    axes.set(xlabel=r"$\Delta$ log-evidence (neo-Hookean $\leftarrow$ 0 $\rightarrow$ quadratic)", xlim=(-reach, reach))
    return figure


@styled
def reliability_figure() -> Figure:
    """Measured once and shipped: (a) stated probability against frequency, (b) the differences themselves."""
    figure = Figure(figsize=(PAGE, 0.36 * PAGE), layout="constrained")
    left, right = figure.subplots(1, 2)
    left.plot([0.5, 1], [0.5, 1], "-", color=LIGHT["muted"], lw=0.8)
    for row, (name, words) in enumerate(measured.EXPERIMENTS.items()):
        difference, quadratic = measured.reliability(name)
        colour, marker = GEL_COLOURS[row], "os"[row]
        found = measured.bins(difference, quadratic)
        left.errorbar(
            [b.stated for b in found], [b.right for b in found], [b.error for b in found], fmt=marker, ms=4,
            color=colour, lw=1, capsize=2, label=words,
        )  # fmt: skip
        for b in found if row == 0 else ():
            left.annotate(f"{b.count}", (b.stated, b.right), (5, -8), textcoords="offset points", fontsize=6)
        favoured = np.where(quadratic, difference, -difference)  # positive: for the law that made the data
        reach = np.clip(favoured, -12, 30)
        right.hist(
            reach, np.arange(-12, 31.5, 1.5), histtype="stepfilled", alpha=0.45, color=colour, ec=colour, lw=1,
            hatch=("", "////")[row],
        )  # fmt: skip
    right.axvspan(-3, 3, color=LIGHT["grid"], zorder=0)
    left.set(xlabel="stated probability", ylabel="right", xlim=(0.48, 1.02), ylim=(0.35, 1.05))
    right.set(xlabel=r"$\Delta$ log-evidence for the true law (ends: beyond)", ylabel="experiments")
    left.set_title("(a)", loc="left")
    right.set_title("(b)", loc="left")
    _legend_above(figure, left, 2)
    return figure
