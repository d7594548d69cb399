"""Posteriors of several runs over each other, as figure and page, from what :mod:`en4dvar.report.compare` has read."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from en4dvar.errors import OutputError
from en4dvar.files import write_text
from en4dvar.report.compare import Comparison, Estimate, ModelScore
from en4dvar.report.html import render
from en4dvar.report.style import COLUMN, LIGHT, inline_svg, save_figure, styled
from en4dvar.report.text import number_like, plain_number, plus_minus, pretty_unit, symbol_html, with_unit
from en4dvar.state import Array
from en4dvar.units import UnitError, convert

COLOURS = (LIGHT["posterior"], LIGHT["centre"], LIGHT["background"], "#cc79a7", "#b58900", LIGHT["muted"])
CAPTION = (
    "Posterior of each run, scaled to its peak; bars hold 5–95 % of the members. Where a run has several data sets, "
    "the members of all of them are taken together."
)


@styled
def overlay(comparison: Comparison) -> Figure:
    """Posterior members of the runs over each other, one panel a parameter, in the display unit of the first run."""
    names = comparison.parameters
    rows = -(-len(names) // 2)
    height = rows * 4.0 / 2.54 + 0.14 * len(comparison.runs)
    figure = Figure(figsize=(COLUMN * (2 if len(names) > 1 else 1), height), layout="constrained")
    grid = figure.subplots(rows, 2 if len(names) > 1 else 1, squeeze=False).ravel()
    for ax in grid[len(names) :]:
        ax.remove()
    for ax, name in zip(grid, names, strict=False):
        _panel(ax, [e for e in comparison.estimates if e.summary.name == name], comparison.runs)
    handles = [grid[0].plot([], [], color=_colour(i), label=run)[0] for i, run in enumerate(comparison.runs)]
    figure.legend(handles=handles, loc="outside upper center", ncols=min(3, len(handles)))
    return figure


def _panel(ax: Axes, estimates: Sequence[Estimate], runs: Sequence[str]) -> None:
    row = estimates[0].summary
    of_run = {run: _members([e for e in estimates if e.run == run], row.unit) for run in runs}
    for i, run in enumerate(runs):
        values = of_run[run]
        if values.size < 2 or np.ptp(values) == 0:
            continue
        bins = int(np.clip(np.ceil(2 * values.size ** (1 / 3)), 6, 30))  # Rice's rule
        counts, edges = np.histogram(values, bins)
        ax.stairs(counts / counts.max(), edges, fill=True, color=_colour(i), alpha=0.25)
        ax.stairs(counts / counts.max(), edges, color=_colour(i), lw=1.0)
        bar = 1.08 + 0.09 * i
        ax.plot(np.quantile(values, (0.05, 0.95)), [bar, bar], color=_colour(i), lw=2, solid_capstyle="butt")
    ax.set(yticks=[], ylim=(0, 1.1 + 0.09 * len(runs)), xlabel=with_unit(row.symbol, row.unit))
    ax.spines["left"].set_visible(False)
    ax.xaxis.set_major_locator(MaxNLocator(5))


def _members(estimates: Sequence[Estimate], unit: str) -> Array:
    """Members of all data sets of a run in ``unit``."""
    try:
        parts = [convert(e.members, e.summary.unit, unit) for e in estimates]
    except UnitError as error:
        raise OutputError(f"the runs mean different quantities by {estimates[0].summary.name}: {error}") from None
    return np.concatenate(parts) if parts else np.empty(0)


def _colour(i: int) -> str:
    return COLOURS[i % len(COLOURS)]


def write_comparison(comparison: Comparison, out: str | Path) -> Path:
    """Write ``compare.html``, ``posteriors.png`` and ``.pdf``, ``estimates.csv`` and ``evidence.csv`` to a folder.

    Files of an earlier comparison there are replaced. Returns the path of the page. Raises :class:`OutputError`.
    """
    out = Path(out)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{out}: cannot be created: {error.strerror}") from None
    figure = overlay(comparison)
    save_figure(figure, out, "posteriors")
    write_text(out / "estimates.csv", _estimates_csv(comparison))
    write_text(out / "evidence.csv", _evidence_csv(comparison))
    page = render(
        "compare.html.j2",
        title=" – ".join(comparison.runs),
        sortable=True,
        figure=Markup(inline_svg(figure, "posteriors", CAPTION)),
        caption=CAPTION,
        incomparable=comparison.incomparable,
        verdicts=[(name, comparison.verdict(name)) for name in comparison.datasets],
        estimates=[_estimate_row(e) for e in _by_parameter(comparison)],
        scores=[_score_row(s) for s in comparison.scores],
    )
    return write_text(out / "compare.html", page)


def _by_parameter(comparison: Comparison) -> list[Estimate]:
    return [e for name in comparison.parameters for e in comparison.estimates if e.summary.name == name]


def _estimate_row(e: Estimate) -> dict[str, object]:
    row = e.summary
    return {
        "symbol": symbol_html(row.symbol),
        "label": row.label,
        "unit": pretty_unit(row.unit),
        "dataset": e.dataset,
        "run": e.run,
        "value": row.mean,
        "posterior": plus_minus(row.mean, row.std),
        "interval": f"{number_like(row.q05, row.std)} … {number_like(row.q95, row.std)}",
        "dfs": f"{100 * row.dfs:.0f} %" if np.isfinite(row.dfs) else "–",
    }


def _score_row(s: ModelScore) -> dict[str, object]:
    return {
        "dataset": s.dataset,
        "run": s.run,
        "numbers": [
            (s.log_evidence, plain_number(s.log_evidence, 6)),
            (s.difference, f"{s.difference:.2f}" if np.isfinite(s.difference) else "–"),
            (s.probability, f"{s.probability:.3f}" if np.isfinite(s.probability) else "–"),
            (s.chi2_per_observation, plain_number(s.chi2_per_observation, 3)),
            (s.dfs, plain_number(s.dfs, 3)),
            (s.effective_parameters, plain_number(s.effective_parameters, 3)),
            (s.nrmse, f"{s.nrmse:.4f}"),
        ],
    }


def _estimates_csv(comparison: Comparison) -> str:
    columns = ("name", "unit", "prior_mean", "prior_std", "mean", "std", "q05", "q50", "q95", "centre", "dfs")
    rows = [[e.run, e.dataset, *(getattr(e.summary, c) for c in columns)] for e in _by_parameter(comparison)]
    return _csv([["run", "dataset", *columns], *rows])


def _evidence_csv(comparison: Comparison) -> str:
    columns = [f.name for f in fields(ModelScore)]
    return _csv([columns, *([getattr(s, c) for c in columns] for s in comparison.scores)])


def _csv(rows: Sequence[Sequence[object]]) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()
