"""What the pages of a campaign say: of one data set, a result turned into rows, sentences and figures for the template;
of all, one table that sorts, warnings counted, estimates side by side.
"""

import json
import math
import sys
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from en4dvar.diagnosis.diagnostics import change_words, chi2_interval
from en4dvar.diagnosis.honesty.checks import MOVED
from en4dvar.diagnosis.residuals import MOST
from en4dvar.estimation.summary import AS_WIDE, ParameterSummary
from en4dvar.plumbing.caution import ABOUT, Caution, codes, gravity, worst_first
from en4dvar.report import responses
from en4dvar.report.chart import COLUMN, PAGE, POINTS, Chart, Panel, Row
from en4dvar.report.figures import all_figures, neighbours, prior_interval, stored_walks
from en4dvar.report.html import render
from en4dvar.report.responses import exceeding, stored_ledger, stored_shifts
from en4dvar.report.svg import Captioned, draw
from en4dvar.report.text import figure_text, number_like, plain_number, pretty_unit, symbol_html, with_unit
from en4dvar.results.store import StoredResult
from en4dvar.results.variables import ITERATIONS, SHARES

OF_WEIGHTS = "of readings that count with other weights than one it may be larger than their errors say", False
UNRELATED = (0.025, 0.975)  # chances of a correlation of neighbours of which nothing is said
IDENTIFIERS = "d0-"  # begin those of figures, which are addresses


def render_set(
    result: StoredResult, trail: Sequence[tuple[str, str]] = (), folder: Path | None = None, begin: str = ""
) -> str:
    """The page of one data set as HTML text; ``trail``: links (words, address) above it. ``folder``: where its figures
    are kept as PDF and PNG too, if anywhere, under names with ``begin``.
    """
    judged, recorded = result.group("sample_stats"), json.loads(str(result.attributes["assimilation_settings"]))
    stats, structured = judged.attrs, any(c.code in ("residual-structure", "odd-residuals") for c in result.cautions)
    chi2, dfs = float(stats["chi2_per_observation"]), float(stats["dfs"])
    weights = result.of_readings("observed_data", "weights", shared=True)
    weighted = bool(np.any((weights != 0) & (weights != 1)))
    change = (str(stats["varying"]), float(stats["log_evidence_change"])) if "log_evidence_change" in stats else None
    return render(
        "set.html.j2",
        result=result,
        trail=trail,
        copies=folder is not None,
        stats=stats,
        rows=result.rows,
        stated=[row.label for row in result.rows if _as_stated(row)],
        lead=[row for row in result.rows if not _as_stated(row)],
        trust=trust(result),
        chi2_words=OF_WEIGHTS if weighted else judge_chi2(chi2, int(stats["n_weighted"]), dfs, structured),
        shares=SHARES if "variance_from_errors" in judged else (),
        what_if=(what_if := stored_shifts(result)),
        exceeding=exceeding(what_if),
        entries=stored_ledger(result),
        readings=responses.reading_words(result),
        walks=stored_walks(result),
        verdict=change_words(*change) if change else "",
        identifiers=IDENTIFIERS,
        drawn={name: (caption, svg) for name, caption, svg in draw(all_figures(result), IDENTIFIERS, folder, begin)},
        judged=judged,
        lost=[(i, str(reason)) for i, reason in enumerate(judged["failure_reason"].values.ravel()) if reason],
        iterations=result.group("iterations"),
        diagnostics=[d.name for d in ITERATIONS if not d.scope and d.name != "active"],
        fixed_values=result.group("constant_data").variables.values(),
        settings=recorded,
        weights=weights,
    )


def _as_stated(row: ParameterSummary) -> bool:
    """Whether the data have neither narrowed nor moved it, and no warning says so: what was known from elsewhere."""
    return row.informed == AS_WIDE and abs(row.mean - row.prior_mean) < MOVED * row.prior_std


def trust(result: StoredResult) -> str:
    """How far the numbers may be trusted, in one or two sentences; "" where warnings say it."""
    stats, worst = result.group("sample_stats").attrs, worst_first(result.cautions)
    if worst and worst[0].severity != "note":
        return ""
    size, _ = judge_chi2(float(stats["chi2_per_observation"]), int(stats["n_weighted"]), float(stats["dfs"]))
    words = f"No warnings: the {size.partition(';')[0]}{_neighbours_words(result)}."
    words += "".join(f" But {c.words}." for c in worst if c.code == "down-weighted")
    if moved := len(exceeding(stored_shifts(result))):
        which = "one assumption matters" if moved == 1 else f"{moved} assumptions matter"
        words += f" The numbers hold for what was assumed: {which} by more than an error bar, see below."
    return words


def _neighbours_words(result: StoredResult) -> str:
    """Whether neighbouring residuals are related more than those of a right model are in 95 of 100 data sets."""
    stats, white = result.group("sample_stats").attrs, responses.whitened(result)
    if "residual_lag_one_chance" in stats:  # a fit makes neighbours of few readings alternate
        correlation, chance = float(stats["residual_lag_one"]), float(stats["residual_lag_one_chance"])
    elif len(white) > MOST:
        correlation = float(neighbours(white)[0][0])
        chance = 0.5 * math.erfc(correlation * math.sqrt(len(white) / 2))
    else:
        return ""
    if not correlation:  # no reading follows another
        return ""
    if UNRELATED[0] <= chance <= UNRELATED[1]:
        return " and neighbouring residuals are unrelated"
    alike = "resemble each other" if chance < 0.5 else "alternate in sign"
    more = f"more than chance explains (correlation {plain_number(correlation, 2)})"
    return f", but neighbouring residuals {alike} {more}: look at them"


def judge_chi2(chi2: float, n_observations: int, dfs: float, structured: bool = False) -> tuple[str, bool]:
    """What χ² per observation says, whether it needs attention; ``structured``: neighbouring residuals are related."""
    if not math.isfinite(chi2):
        return "cannot be told", True
    if not n_observations:
        return "bounds tell no size of errors; this is the sum of their squares where they do not hold", False
    low, high = chi2_interval(max(1.0, n_observations - dfs))
    expected = f"expected are {plain_number(low / n_observations, 2)} to {plain_number(high / n_observations, 2)}"
    if chi2 * n_observations > high:
        return f"misfit exceeds the stated noise: model or noise is wrong; {expected}", True
    if n_observations - dfs <= 1:
        return "misfit tells nothing of the noise: the fit determines about as many numbers as it has readings", False
    if chi2 * n_observations < low:
        return f"misfit is below the stated noise, which may be overstated; {expected}", True
    if structured:
        return f"the size of the misfit is as stated, its structure is not; {expected}", True
    return f"misfit agrees with the stated noise; {expected}", False


# The first page of a campaign

NAMED = 40  # data sets whose names fit below a figure
LISTED = 2000  # data sets in the table: a browser shows as many at once
Headline = tuple[str, str, Sequence[str], Sequence[Captioned], Sequence[Caution]]
"""What data sets say together: the address of a page and words for it, lines of the answer, figures, warnings."""


@dataclass(frozen=True)
class SetSummary:
    """What the overview keeps of one data set: a row a parameter, the scalars of its fit, its warnings, the 5 and 95 %
    of each prior.
    """

    name: str
    stem: str
    rows: Mapping[str, ParameterSummary]
    cautions: tuple[Caution, ...]
    scalars: Mapping[str, float]
    about: Mapping[str, str] = field(default_factory=dict)
    priors: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    @classmethod
    def of(cls, result: StoredResult, stem: str) -> "SetSummary":
        """``stem``: name of the file without suffix."""
        stats = result.groups["/sample_stats"].attrs
        keys = ("n_observations", "chi2_per_observation", "nrmse", "dfs", "n_active", "n_members")
        about = {key: sys.intern(str(result.attributes.get(key, ""))) for key in ("date_created", "configuration")}
        scalars = {key: float(stats[key]) for key in keys}
        rows, priors = {row.name: row for row in result.rows}, {n: prior_interval(result, n) for n in result.parameters}
        return cls(result.name, stem, rows, result.cautions, scalars, about, priors)

    @property
    def worst(self) -> str:
        """The gravest severity among the warnings, "" where there are none."""
        return worst_first(self.cautions)[0].severity if self.cautions else ""

    @property
    def gravity(self) -> float:
        """Sorts by warnings: 0 none; what the worst of them does to the numbers counts most."""
        return gravity(self.cautions)

    @property
    def codes(self) -> str:
        return ", ".join(codes(self.cautions))


def render_overview(sets: Sequence[SetSummary], headlines: Sequence[Headline] = (), **shown: Any) -> str:
    """The page as HTML. Also shown: ``pages``, stem of a data set → address of its page, for those that have one;
    ``failures``, name of one without a posterior → reason; drawn ``figures``.
    """
    worst = set(map(id, sorted(sets, key=lambda s: -s.gravity)[:LISTED]))
    listed, parameters = [s for s in sets if id(s) in worst], [_parameter(name, sets) for name in _parameters(sets)]
    shown |= {"listed": listed, "parameters": parameters, "tally": _tally(sets)}
    told = [(*told, draw(figures, f"together{i}-"), cautions) for i, (*told, figures, cautions) in enumerate(headlines)]
    return render("campaign.html.j2", sets=sets, headlines=told, **shown)


def estimates(sets: Sequence[SetSummary], names: Sequence[str] = ()) -> Chart:
    """Mean and 5–95 % of every data set, a panel a name (default: each parameter); many are sorted, as a band."""
    names, few = names or _parameters(sets), len(sets) <= NAMED
    panels = [_estimates(name, sets, few) for name in names]
    rows = [Row(3.0 * POINTS, [panel]) for panel in panels]
    if few:
        labels = [figure_text(dataset.name) for dataset in sets]
        panels[-1].x_numbers, panels[-1].names = True, labels
        rows[-1] = Row((3.0 + 0.14 * max(map(len, labels))) * POINTS, [panels[-1]])
    return Chart(rows, PAGE if few else COLUMN)


def _estimates(name: str, sets: Sequence[SetSummary], few: bool) -> Panel:
    x = np.array([i for i, dataset in enumerate(sets) if name in dataset.rows])
    rows = [sets[i].rows[name] for i in x]
    mean, low, high = (np.array([getattr(row, key) for row in rows]) for key in ("middle", "q05", "q95"))
    trusted = np.array([not row.untrusted for row in rows], dtype=bool)
    low, high = (np.where(trusted, bound, np.nan) for bound in (low, high))
    panel = Panel(ylabel=with_unit(rows[0].symbol, rows[0].unit), yticks=4, x_numbers=False)
    order = np.argsort(mean)
    least, most = np.array([sets[i].priors[name] for i in x]).T
    if max(np.ptp(least), np.ptp(most)) <= 0.1 * (most - least).min():
        panel.span(float(least[0]), float(most[0]), "prior", 0.2)
    elif few:
        for at, bottom, top in zip(x, least, most, strict=True):
            panel.band((at - 0.5, at + 0.5), (bottom, bottom), (top, top), "prior", 0.2)
    else:
        panel.band(np.arange(len(x)), least[order], most[order], "prior", 0.2)
    if few:
        panel.xlim, panel.xticks = (-0.6, len(sets) - 0.4), range(len(sets))
        panel.bars(x, low, high, "posterior", 1.4, 0.6)
        panel.dots(x, mean, "posterior", 3.0)
        panel.dots(x[~trusted], mean[~trusted], "centre", 5.5, kind="rings")
    else:
        ranks = np.arange(len(mean))
        panel.xlabel, panel.xticks = f"{len(order)} data sets, sorted", ()
        panel.band(ranks, low[order], high[order], "posterior", 0.3)
        panel.line(ranks, mean[order], "posterior", 0.9)
    reach = [v for values in (mean, low, high) for v in values[np.isfinite(values)]]
    if reach and max(reach) > min(reach):
        margin = 0.08 * (max(reach) - min(reach))
        panel.ylim = float(min(reach) - margin), float(max(reach) + margin)
    return panel


def overview_figures(sets: Sequence[SetSummary], population: Collection[str] = ()) -> list[Captioned]:
    """The estimates; where there is a ``population``, those of its parameters first and the others by themselves."""
    rings = any(row.untrusted for dataset in sets for row in dataset.rows.values())
    caption = (
        "Each data set by itself: posterior mean and 5–95 % (blue), 5–95 % of the prior (grey, each data set's own "
        "where they differ clearly)." + " Orange rings without a bar: not to be trusted, for their warnings." * rings
        if len(sets) <= NAMED
        else "Data sets sorted by the posterior mean, with 5–95 % (blue, none where it is not to be trusted); 5–95 % "
        "of the prior (grey, each data set's own where they differ clearly)."
    )
    names = _parameters(sets)
    first = [name for name in names if name in population] or names
    parts = {"estimates": first, "others": [name for name in names if name not in first]}
    return [(name, caption, estimates(sets, of)) for name, of in parts.items() if of]


def _parameters(sets: Sequence[SetSummary]) -> list[str]:
    return list(dict.fromkeys(name for dataset in sets for name in dataset.rows))


def _parameter(name: str, sets: Sequence[SetSummary]) -> dict[str, Any]:
    rows = [dataset.rows[name] for dataset in sets if name in dataset.rows]
    means = np.array([row.mean for row in rows if math.isfinite(row.mean) and not row.untrusted])
    quartiles = np.quantile(means, (0.25, 0.5, 0.75)).tolist() if means.size else (math.nan,) * 3
    precision = float(np.nanmedian([row.std for row in rows])) if means.size else math.nan
    numbers = {key: number_like(x, precision) for key, x in zip(("low", "median", "high"), quartiles, strict=True)}
    symbol, unit = symbol_html(rows[0].symbol), pretty_unit(rows[0].unit)
    return {"name": name, "label": rows[0].label, "symbol": symbol, "unit": unit, **numbers}


def _tally(sets: Sequence[SetSummary]) -> list[dict[str, Any]]:
    """One line a code: in how many data sets, with the words of the first of them."""
    every = [(c, dataset.name) for dataset in sets for c in dataset.cautions]
    count = Counter(key for dataset in sets for key in {(c.severity, c.code) for c in dataset.cautions})
    first: dict[tuple[str, str], tuple[Caution, str]] = {}
    for c, name in every:
        first.setdefault((c.severity, c.code), (c, name))
    return [
        {"severity": c.severity, "code": c.code, "about": ABOUT.get(c.code), "count": count[c.severity, c.code],
         "advice": c.advice, "example": f"e.g. {first[c.severity, c.code][1]}: {c.words}"}
        for c in worst_first(tuple(c for c, _ in first.values()))
    ]  # fmt: skip
