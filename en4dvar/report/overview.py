"""The first page of a campaign: all data sets in one table that sorts, warnings counted, estimates side by side."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure

from en4dvar.caution import SEVERITIES, Caution, worst_first
from en4dvar.report.html import render
from en4dvar.report.style import COLUMN, LIGHT, PAGE, inline_svg, styled
from en4dvar.report.text import number_like, plain_number, plus_minus, pretty_unit, symbol_html, with_unit
from en4dvar.storage.store import ParameterSummary, StoredResult

NAMED = 40  # data sets whose names fit below a figure


@dataclass(frozen=True)
class Entry:
    """What the overview keeps of one data set: its rows, the scalars of its fit, its warnings."""

    name: str
    stem: str
    summary: tuple[ParameterSummary, ...]
    cautions: tuple[Caution, ...]
    scalars: Mapping[str, float]
    about: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def of(cls, result: StoredResult, stem: str) -> Entry:
        """``stem``: name of the file without suffix."""
        stats = result.sample_stats.attrs
        keys = ("n_observations", "chi2_per_observation", "nrmse", "dfs", "n_active", "n_members")
        about = {key: str(result.attributes.get(key, "")) for key in ("date_created", "configuration")}
        scalars = {key: float(stats[key]) for key in keys}
        return cls(result.name, stem, result.summary(), result.cautions, scalars, about)

    @property
    def worst(self) -> str:
        """The gravest severity among the warnings, "" where there are none."""
        return worst_first(self.cautions)[0].severity if self.cautions else ""

    @property
    def gravity(self) -> int:
        """Sorts by warnings: 0 none; then the worst severity counts most, the number of warnings within it."""
        order: tuple[str, ...] = ("", *reversed(SEVERITIES))
        rank = order.index(self.worst) if self.worst in order else 1
        return 100 * rank + len(self.cautions)

    def of_parameter(self, name: str) -> ParameterSummary | None:
        return next((row for row in self.summary if row.name == name), None)


def render_overview(
    entries: Sequence[Entry],
    pages: Mapping[str, str],
    failures: Mapping[str, str],
    figures: Iterable[tuple[str, str, Figure]],
) -> str:
    """The page as HTML.

    ``pages``: stem of a data set → address of its page, for those that have one; ``failures``: name of a data set
    without a posterior → reason; ``figures``: (name, caption, figure).
    """
    parameters = _parameters(entries)
    return render(
        "campaign.html.j2",
        sortable=True,
        title=f"{len(entries)} data sets",
        created=entries[0].about.get("date_created", ""),
        configuration=entries[0].about.get("configuration", ""),
        parameters=[_parameter(name, entries) for name in parameters],
        failures=failures,
        sets=[_row(entry, parameters, pages.get(entry.stem, "")) for entry in entries],
        without_page=sum(1 for entry in entries if entry.stem not in pages),
        warned=sum(1 for entry in entries if entry.cautions),
        tally=_tally(entries),
        figures=[(name, caption, Markup(inline_svg(figure, name, caption))) for name, caption, figure in figures],
    )


@styled
def estimates(entries: Sequence[Entry]) -> Figure:
    """Mean and 5–95 % of every data set, one panel a parameter; with many data sets sorted by the mean, as a band."""
    names = _parameters(entries)
    few = len(entries) <= NAMED
    width = PAGE if few else COLUMN
    figure = Figure(figsize=(width, len(names) * 3.0 / 2.54 + (2.0 / 2.54 if few else 0)), layout="constrained")
    panels = figure.subplots(len(names), 1, squeeze=False, sharex=few).ravel()
    for ax, name in zip(panels, names, strict=True):
        rows = [row for entry in entries if (row := entry.of_parameter(name)) is not None]
        mean, low, high = (np.array([getattr(row, key) for row in rows]) for key in ("mean", "q05", "q95"))
        x = np.array([i for i, entry in enumerate(entries) if entry.of_parameter(name) is not None])
        prior = rows[0].prior_mean + np.array([-1.0, 1.0]) * rows[0].prior_std
        ax.axhspan(*prior, color=LIGHT["prior"], alpha=0.2, lw=0)
        if few:
            ax.vlines(x, low, high, color=LIGHT["posterior"], lw=1.4, alpha=0.6)
            ax.plot(x, mean, "o", ms=3, color=LIGHT["posterior"])
            warned = np.array([entries[i].worst == "serious" for i in x], dtype=bool)
            ax.plot(x[warned], mean[warned], "o", ms=5.5, mfc="none", mew=0.9, color=LIGHT["centre"])
        else:
            order = np.argsort(mean)
            ax.fill_between(np.arange(len(order)), low[order], high[order], color=LIGHT["posterior"], alpha=0.3, lw=0)
            ax.plot(np.arange(len(order)), mean[order], color=LIGHT["posterior"], lw=0.9)
            ax.set_xticks([])
            ax.set_xlabel(f"{len(order)} data sets, sorted")
        reach = [*low[np.isfinite(low)], *high[np.isfinite(high)]]
        if reach and max(reach) > min(reach):
            margin = 0.08 * (max(reach) - min(reach))
            ax.set_ylim(min(reach) - margin, max(reach) + margin)
        ax.set_ylabel(with_unit(rows[0].symbol, rows[0].unit))
    if few:
        panels[-1].set_xlim(-0.6, len(entries) - 0.4)
        panels[-1].set_xticks(range(len(entries)), [_plain(entry.name) for entry in entries], rotation=90)
    return figure


def overview_figures(entries: Sequence[Entry]) -> list[tuple[str, str, Figure]]:
    """(name, caption, figure) of the overview."""
    caption = (
        "Each data set by itself: posterior mean and 5–95 % (blue), prior mean ± std (grey band; of the first data set "
        "where priors depend on the data). Orange rings: posteriors with serious warnings."
        if len(entries) <= NAMED
        else "Data sets sorted by the posterior mean, with 5–95 % (blue); prior mean ± std (grey band; of the first "
        "data set where priors depend on the data)."
    )
    return [("estimates", caption, estimates(entries))]


def _parameters(entries: Sequence[Entry]) -> list[str]:
    return list(dict.fromkeys(row.name for entry in entries for row in entry.summary))


def _parameter(name: str, entries: Sequence[Entry]) -> dict[str, Any]:
    rows = [row for entry in entries if (row := entry.of_parameter(name)) is not None]
    means = np.array([row.mean for row in rows if math.isfinite(row.mean)])
    low, median, high = np.quantile(means, (0.25, 0.5, 0.75)) if means.size else (math.nan,) * 3
    precision = float(np.nanmedian([row.std for row in rows])) if means.size else math.nan
    return {
        "name": name,
        "label": rows[0].label,
        "symbol": symbol_html(rows[0].symbol),
        "unit": pretty_unit(rows[0].unit),
        "median": number_like(float(median), precision),
        "low": number_like(float(low), precision),
        "high": number_like(float(high), precision),
    }


def _row(entry: Entry, parameters: Sequence[str], page: str) -> dict[str, Any]:
    rows = [entry.of_parameter(name) for name in parameters]
    s = entry.scalars
    return {
        "name": entry.name,
        "page": page,
        "estimates": [(repr(row.mean), plus_minus(row.mean, row.std)) if row else ("", "") for row in rows],
        "scalars": [
            (repr(s["n_observations"]), f"{s['n_observations']:.0f}"),
            *((repr(s[key]), plain_number(s[key], 3)) for key in ("chi2_per_observation", "nrmse", "dfs")),
            (repr(s["n_active"]), f"{s['n_active']:.0f} of {s['n_members']:.0f}"),
        ],
        "gravity": entry.gravity,
        "worst": entry.worst,
        "codes": ", ".join(dict.fromkeys(c.code for c in entry.cautions)),
    }


def _tally(entries: Sequence[Entry]) -> list[dict[str, Any]]:
    """One line a code: in how many data sets, with the words of the first of them."""
    found: dict[tuple[str, str], list[tuple[str, Caution]]] = {}
    for c in worst_first(tuple(c for entry in entries for c in entry.cautions)):
        found.setdefault((c.severity, c.code), [])
    for entry in entries:
        for key in dict.fromkeys((c.severity, c.code) for c in entry.cautions):
            found[key].append((entry.name, next(c for c in entry.cautions if (c.severity, c.code) == key)))
    return [
        {
            "severity": severity,
            "code": code,
            "count": len(where),
            "example": f"e.g. {where[0][0]}: {where[0][1].words}",
            "advice": where[0][1].advice,
        }
        for (severity, code), where in found.items()
    ]


def _plain(name: str) -> str:
    """A data set's name as text of a figure: no mathtext, not longer than a label can be."""
    short = name if len(name) <= 24 else f"{name[:11]}…{name[-12:]}"
    return short.replace("$", r"\$")
