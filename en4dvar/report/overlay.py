"""Posteriors of several runs over each other, as figure and page, from what :mod:`en4dvar.report.compare` has read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path

import numpy as np

from en4dvar.diagnosis.intervals import member_quantiles
from en4dvar.estimation.summary import CSV_COLUMNS, csv_cells
from en4dvar.model.state import Array
from en4dvar.plumbing.errors import OutputError
from en4dvar.plumbing.files import make_folder, write_text
from en4dvar.plumbing.tables import csv_text
from en4dvar.plumbing.units import UnitError, convert
from en4dvar.report import populations
from en4dvar.report.chart import COLUMN, POINTS, Chart, Panel, in_columns
from en4dvar.report.compare import ComparedEstimate, Comparison, ModelScore
from en4dvar.report.drawing import keep
from en4dvar.report.html import render
from en4dvar.report.page import DFS_WORDS
from en4dvar.report.populations import PopulationsCompared
from en4dvar.report.svg import svg
from en4dvar.report.text import figure_text, with_unit

COLOURS = ("posterior", "centre", "background", "#cc79a7", "#b58900", "muted")
CAPTION = (
    "Posterior of each run, scaled to its peak; bars hold 5–95 % of the members, where these are to be trusted. "
    "Where a run has several data sets, "
    "the members of all of them are taken together."
)


def overlay(comparison: Comparison) -> Chart:
    """Posterior members of the runs over each other, one panel a parameter, in the display unit of the first run."""
    names = comparison.parameters
    panels = [_panel([e for e in comparison.estimates if e.summary.name == name], comparison.runs) for name in names]
    panels[0].legend = True
    height = (4.0 + 0.15 * len(comparison.runs)) * POINTS
    return in_columns(panels, height, width=COLUMN * (2 if len(names) > 1 else 1))


def _panel(estimates: Sequence[ComparedEstimate], runs: Sequence[str]) -> Panel:
    row = estimates[0].summary
    panel = Panel(with_unit(row.symbol, row.unit), yticks=(), left=False, ylim=(0.0, 1.1 + 0.09 * len(runs)))
    for i, run in enumerate(runs):
        label = figure_text(run)
        panel.line([], [], _colour(i), label=label)
        values = _members([e for e in estimates if e.run == run], row.unit)
        if values.size < 2 or np.ptp(values) == 0:
            continue
        panel.histogram(values, _colour(i), alpha=0.25)
        if not any(e.summary.untrusted for e in estimates if e.run == run):
            low, high = member_quantiles(values, (0.05, 0.95))
            panel.line([low, high], np.full(2, 1.08 + 0.09 * i), _colour(i), 2.0)
    return panel


def _members(estimates: Sequence[ComparedEstimate], unit: str) -> Array:
    """Members of all data sets of a run in ``unit``."""
    try:
        parts = [convert(e.members, e.summary.unit, unit) for e in estimates]
    except UnitError as error:
        raise OutputError(f"the runs mean different quantities by {estimates[0].summary.name}: {error}") from None
    return np.concatenate(parts) if parts else np.empty(0)


def _colour(i: int) -> str:
    return COLOURS[i % len(COLOURS)]


def write_comparison(comparison: Comparison, out: str | Path, of: PopulationsCompared | None = None) -> Path:
    """Write ``compare.html``, ``posteriors.png`` and ``.pdf``, ``estimates.csv`` and ``evidence.csv`` to a folder; or
    in place of all but the page, of populations, ``populations.png`` and ``.pdf`` and ``differences.csv``.

    Files of an earlier comparison there are replaced. Returns the path of the page. Raises :class:`OutputError`.
    """
    out = make_folder(out)
    content = {"populations": (), "figure": ""}
    if of:
        chart = populations.figure(of)
        keep(chart, out, "populations")
        populations.write_tables(of, out)
        content |= {
            "populations": tuple(populations.sentences(of)),
            "populations_figure": svg(chart, "populations", populations.CAPTION),
            "populations_caption": populations.CAPTION,
        }
    else:
        chart = overlay(comparison)
        keep(chart, out, "posteriors")
        write_text(out / "estimates.csv", _estimates_csv(comparison))
        write_text(out / "evidence.csv", _evidence_csv(comparison))
        content |= {"figure": svg(chart, "posteriors", CAPTION)}
    page = render(
        "compare.html.j2",
        title=" – ".join(of.populations if of else comparison.runs),
        caption=CAPTION,
        incomparable=comparison.incomparable,
        verdicts=[(name, comparison.verdict(name)) for name in comparison.datasets],
        estimates=comparison.by_parameter,
        scores=comparison.scores,
        cautions=[(c.caution, f"{c.run}, {c.dataset}: ") for c in comparison.cautions],
        dfs_words=DFS_WORDS,
        **content,
    )
    return write_text(out / "compare.html", page)


def _estimates_csv(comparison: Comparison) -> str:
    warned = {(s.run, s.dataset): s.warnings for s in comparison.scores}
    rows = [[e.run, e.dataset, *csv_cells(e.summary), warned[e.run, e.dataset]] for e in comparison.by_parameter]
    return csv_text([["run", "dataset", *CSV_COLUMNS, "warnings"], *rows])


def _evidence_csv(comparison: Comparison) -> str:
    columns = [f.name for f in fields(ModelScore)]
    return csv_text([columns, *([getattr(s, c) for c in columns] for s in comparison.scores)])
