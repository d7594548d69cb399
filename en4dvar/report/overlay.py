"""Posteriors of several runs over each other, as figure and page, from what :mod:`en4dvar.report.compare` has read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from en4dvar.errors import OutputError
from en4dvar.files import make_folder, write_text
from en4dvar.report.compare import ComparedEstimate, Comparison, ModelScore
from en4dvar.report.html import render
from en4dvar.report.page import DFS_WORDS
from en4dvar.report.style import COLUMN, LIGHT, inline_svg, panels, save_figure, scaled_histogram, styled
from en4dvar.report.text import figure_text, with_unit
from en4dvar.state import Array
from en4dvar.summary import CSV_COLUMNS, csv_cells
from en4dvar.tables import csv_text
from en4dvar.units import UnitError, convert

COLOURS = (LIGHT["posterior"], LIGHT["centre"], LIGHT["background"], "#cc79a7", "#b58900", LIGHT["muted"])
CAPTION = (
    "Posterior of each run, scaled to its peak; bars hold 5–95 % of the members, where these are to be trusted. "
    "Where a run has several data sets, "
    "the members of all of them are taken together."
)


@styled
def overlay(comparison: Comparison) -> Figure:
    """Posterior members of the runs over each other, one panel a parameter, in the display unit of the first run."""
    names = comparison.parameters
    width = COLUMN * (2 if len(names) > 1 else 1)
    figure, axes = panels(len(names), width, 4.0 / 2.54, above=0.14 * len(comparison.runs))
    for ax, name in zip(axes, names, strict=True):
        _panel(ax, [e for e in comparison.estimates if e.summary.name == name], comparison.runs)
    labels = map(figure_text, comparison.runs)
    handles = [axes[0].plot([], [], color=_colour(i), label=label)[0] for i, label in enumerate(labels)]
    figure.legend(handles=handles, loc="outside upper center", ncols=min(3, len(handles)))
    return figure


def _panel(ax: Axes, estimates: Sequence[ComparedEstimate], runs: Sequence[str]) -> None:
    row = estimates[0].summary
    for i, run in enumerate(runs):
        values = _members([e for e in estimates if e.run == run], row.unit)
        if values.size < 2 or np.ptp(values) == 0:
            continue
        scaled_histogram(ax, values, _colour(i), alpha=0.25, lw=1.0)
        if any(e.summary.untrusted for e in estimates if e.run == run):
            continue
        bar = 1.08 + 0.09 * i
        ax.plot(np.quantile(values, (0.05, 0.95)), [bar, bar], color=_colour(i), lw=2, solid_capstyle="butt")
    ax.set(yticks=[], ylim=(0, 1.1 + 0.09 * len(runs)), xlabel=with_unit(row.symbol, row.unit))
    ax.spines["left"].set_visible(False)
    ax.xaxis.set_major_locator(MaxNLocator(5))


def _members(estimates: Sequence[ComparedEstimate], unit: str) -> Array:
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
    out = make_folder(out)
    figure = overlay(comparison)
    save_figure(figure, out, "posteriors")
    write_text(out / "estimates.csv", _estimates_csv(comparison))
    write_text(out / "evidence.csv", _evidence_csv(comparison))
    page = render(
        "compare.html.j2",
        title=" – ".join(comparison.runs),
        sortable=True,
        figure=inline_svg(figure, "posteriors", CAPTION),
        caption=CAPTION,
        incomparable=comparison.incomparable,
        verdicts=[(name, comparison.verdict(name)) for name in comparison.datasets],
        estimates=comparison.by_parameter,
        scores=comparison.scores,
        cautions=[(c.caution, f"{c.run}, {c.dataset}: ") for c in comparison.cautions],
        dfs_words=DFS_WORDS,
    )
    return write_text(out / "compare.html", page)


def _estimates_csv(comparison: Comparison) -> str:
    warned = {(s.run, s.dataset): s.warnings for s in comparison.scores}
    rows = [[e.run, e.dataset, *csv_cells(e.summary), warned[e.run, e.dataset]] for e in comparison.by_parameter]
    return csv_text([["run", "dataset", *CSV_COLUMNS, "warnings"], *rows])


def _evidence_csv(comparison: Comparison) -> str:
    columns = [f.name for f in fields(ModelScore)]
    return csv_text([columns, *([getattr(s, c) for c in columns] for s in comparison.scores)])
