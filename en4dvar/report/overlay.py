"""Posteriors of several runs over each other, as figure and page, from what :mod:`en4dvar.report.compare` has read."""

from dataclasses import fields
from pathlib import Path

from en4dvar.estimation.summary import CSV_COLUMNS, csv_cells
from en4dvar.plumbing.files import make_folder, write_text
from en4dvar.plumbing.tables import csv_text
from en4dvar.report import populations
from en4dvar.report.compare import Comparison, ModelScore, overlay
from en4dvar.report.html import render
from en4dvar.report.page import DFS_WORDS
from en4dvar.report.populations import PopulationsCompared
from en4dvar.report.svg import keep, svg

CAPTION = (
    "Posterior of each run, scaled to its peak; bars hold 5–95 % of the members, where these are to be trusted. "
    "Where a run has several data sets, "
    "the members of all of them are taken together."
)


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
        warned = {(s.run, s.dataset): s.warnings for s in comparison.scores}
        rows = ([e.run, e.dataset, *csv_cells(e.summary), warned[e.run, e.dataset]] for e in comparison.by_parameter)
        write_text(out / "estimates.csv", csv_text([["run", "dataset", *CSV_COLUMNS, "warnings"], *rows]))
        columns = [f.name for f in fields(ModelScore)]
        evidence = ([getattr(s, c) for c in columns] for s in comparison.scores)
        write_text(out / "evidence.csv", csv_text([columns, *evidence]))
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
