"""What the reports of twin experiments and of sequences share: the page, axes along time, the rank histogram."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.stats import binom

from en4dvar.files import inside, write_text
from en4dvar.report.html import render
from en4dvar.report.page import provenance_rows
from en4dvar.report.style import COLUMN, LIGHT, Captioned, draw, styled
from en4dvar.report.text import with_unit

Table = tuple[str, Sequence[str], Sequence[Sequence[str]], str]  # heading, columns, rows, words below it
BINS = 10
RANKS = (
    "Rank histogram: where each observation fell among the forecast members, errors of the observations added. A "
    "reliable ensemble has flat bars, 95 % of them inside the band; a valley is too little spread, a hill too much."
)


def write_cycles_page(
    run_dir: Path,
    data: xr.Dataset,
    *,
    kind: str,
    what: str,
    facts: Sequence[tuple[str, str, str]],
    tables: Sequence[Table],
    figures: Iterable[Captioned],
) -> Path:
    """Write figures (PDF and PNG) and ``report.html``; returns the path of the page."""
    a = data.attrs
    page = render(
        "cycles.html.j2",
        title=str(a["name"]),
        created=str(a.get("date_created", "")),
        kind=kind,
        what=what,
        facts=facts,
        tables=tables,
        figures=draw(figures, inside(run_dir, "figures")),
        warnings=_lines(a.get("warnings", "")),
        lost=_lines(a["members_lost_why"]),
        provenance=provenance_rows(a),
        configuration=str(a["configuration_resolved"]),
    )
    return write_text(run_dir / "report.html", page)


def stacked_axes(n: int, height: float, width: float = COLUMN) -> tuple[Figure, Sequence[Axes]]:
    """``n`` axes below each other, of a height in cm, under room for a legend."""
    figure = Figure(figsize=(width, (1.2 + height * n) / 2.54), layout="constrained")
    return figure, list(figure.subplots(n, 1, sharex=True, squeeze=False)[:, 0])


def labelled(figure: Figure, stack: Sequence[Axes], unit: str) -> Figure:
    """With a legend above and the axis of time."""
    for ax in stack:
        ax.margins(x=0)
    figure.legend(*stack[0].get_legend_handles_labels(), loc="outside upper right", ncols=4)
    stack[-1].set_xlabel(with_unit("time", unit))
    return figure


@styled
def ranks(data: xr.Dataset) -> Figure:
    """The rank histogram of all observations, with the band that holds 95 % of the bars of a reliable ensemble."""
    found = data["rank"].values[np.isfinite(data["rank"].values)]
    members = int(data.attrs["members"])
    placed = (members * found + 0.5) / (members + 1)  # of the N + 1 places among N members
    counts, edges = np.histogram(placed, BINS, (0, 1))
    figure = Figure(figsize=(COLUMN, 5 / 2.54), layout="constrained")
    ax = figure.subplots()
    low, high = binom.ppf([0.025, 0.975], len(found), 1 / BINS) / max(1, len(found))
    ax.axhspan(low, high, color=LIGHT["grid"], alpha=0.6, lw=0)
    ax.stairs(counts / max(1, len(found)), edges, fill=True, color=LIGHT["prior"], alpha=0.7)
    ax.axhline(1 / BINS, color=LIGHT["ink"], lw=0.6)
    ax.set_xlim(0, 1)
    ax.set_xlabel("rank of the observation, 0 to 1")
    ax.set_ylabel(f"share of {len(found)}")
    return figure


def _lines(text: object) -> list[str]:
    return [line for line in str(text).split("\n") if line]
