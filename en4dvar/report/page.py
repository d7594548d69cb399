"""What the page of one data set says: a result turned into rows, sentences and figures for the template."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from markupsafe import Markup
from matplotlib.figure import Figure

from en4dvar.diagnostics import chi2_interval
from en4dvar.report.html import render
from en4dvar.report.style import inline_svg
from en4dvar.report.text import (
    DFS_WORDS,
    number_like,
    plain_number,
    plus_minus,
    pretty_unit,
    symbol_html,
    words_for,
)
from en4dvar.storage.groups import ITERATION_SCALARS
from en4dvar.storage.store import StoredResult
from en4dvar.summary import ParameterSummary
from en4dvar.units import convert

PROVENANCE = (
    "history", "date_created", "seed", "data_source", "git_commit", "configuration_file", "configuration_git_commit",
    "package_versions", "python_version", "platform", "cpu", "institution", "references", "Conventions",
)  # fmt: skip
ANCHOR = "d0"  # begins the identifiers of figures, which are addresses


@dataclass(frozen=True)
class Page:
    """What the template asks of a result."""

    result: StoredResult

    @property
    def stats(self) -> dict[Any, Any]:
        return self.result.sample_stats.attrs

    @property
    def rows(self) -> list[dict[str, Any]]:
        """The table of parameters, as text."""
        return [_row(row) for row in self.result.summary()]

    @property
    def verdicts(self) -> list[tuple[str, str, str, bool]]:
        """(quantity, value, in plain words, needs attention) for the tiles on top."""
        s = self.stats
        alive, members, n_estimated = int(s["n_active"]), int(s["n_members"]), len(self.result.posterior.data_vars)
        chi2, dfs, nrmse = (float(s[key]) for key in ("chi2_per_observation", "dfs", "nrmse"))
        chi2_words, chi2_odd = judge_chi2(chi2, int(s["n_weighted"]), dfs)
        informed = f"of {n_estimated} parameters determined by the data"
        ended = "by its own criterion" if s["converged"] else "not converged"
        return [
            ("Fit, NRMSE", number_like(nrmse, 0.01), "1 is perfect, 0 is no better than a constant", not nrmse >= 0.9),
            ("χ² per observation", plain_number(chi2, 3), chi2_words, chi2_odd),
            ("Information, DFS", plain_number(dfs, 3), informed, False),
            ("Members alive", f"{alive} of {members}", "of the posterior ensemble", alive < members),
            ("Iterations", str(s["n_iterations"]), f"{ended}: {s['stop_reason']}", not s["converged"]),
        ]

    @property
    def failures(self) -> list[tuple[int, str]]:
        """(member, reason) of every member that did not survive."""
        reasons = self.result.sample_stats["failure_reason"].values.ravel()
        return [(i, str(reason)) for i, reason in enumerate(reasons) if reason]

    @property
    def fixed(self) -> list[tuple[Markup, str, str, str]]:
        """(symbol, label, value, unit) of the values held fixed."""
        rows = []
        for variable in self.result.dataset("constant_data").data_vars.values():
            a = variable.attrs
            unit = a.get("display_units", a["units"])
            value = convert(float(variable), a["units"], unit)
            rows.append((symbol_html(a["symbol"]), a["long_name"], plain_number(value, 6), pretty_unit(unit)))
        return rows

    @property
    def iterations(self) -> list[list[str]]:
        """One line an iteration: index, J, terms, step, χ²/Ky, DFS, spread, members."""
        table = self.result.iterations
        keys = [key for key in ITERATION_SCALARS if key != "active"]
        columns = [
            [str(int(i)) for i in table["iteration"]],
            *([plain_number(float(value)) for value in table[key]] for key in keys),
            [str(int(n)) for n in table["active"]],
        ]
        return [list(line) for line in zip(*columns, strict=True)]

    @property
    def settings(self) -> list[tuple[str, str]]:
        """The scheme's settings and how observations are weighted."""
        given = json.loads(str(self.result.attributes["assimilation_settings"]))
        weights = self.result.observed_data["weights"].values
        total = f"{len(weights)} observations, weights sum to {plain_number(float(weights.sum()))}"
        return [*((key.replace("_", " "), str(value)) for key, value in given.items()), ("observations", total)]

    @property
    def provenance(self) -> list[tuple[str, str]]:
        return provenance_rows(self.result.attributes)


def provenance_rows(attributes: Mapping[Any, Any]) -> list[tuple[str, str]]:
    """(what, value) of what a file says of its origin."""
    return [(key.replace("_", " "), str(attributes[key])) for key in PROVENANCE if str(attributes.get(key, ""))]


def _row(row: ParameterSummary) -> dict[str, Any]:
    return {
        "symbol": symbol_html(row.symbol),
        "label": row.label,
        "unit": pretty_unit(row.unit),
        "prior": plus_minus(row.prior_mean, row.prior_std),
        "posterior": plus_minus(row.mean, row.std),
        "mean": number_like(row.mean, row.std),
        "std": number_like(row.std, row.std),
        "quantiles": [number_like(q, row.std) for q in (row.q05, row.q50, row.q95)],
        "centre": number_like(row.centre, row.std),
        "dfs": f"{100 * row.dfs:.0f} %" if math.isfinite(row.dfs) else "–",
        "share": min(max(row.dfs, 0.0), 1.0) if math.isfinite(row.dfs) else 0.0,
        "hint": words_for(row.dfs, DFS_WORDS),
    }


def judge_chi2(chi2: float, n_observations: int, dfs: float) -> tuple[str, bool]:
    """What χ² per observation says in plain words, and whether it needs attention (as warnings of the run do)."""
    if not math.isfinite(chi2):
        return "cannot be told", True
    low, high = chi2_interval(max(1.0, n_observations - dfs))
    expected = f"expected are {plain_number(low / n_observations, 2)} to {plain_number(high / n_observations, 2)}"
    if chi2 * n_observations > high:
        return f"misfit exceeds the stated noise: model or noise is wrong; {expected}", True
    if chi2 * n_observations < low:
        return f"misfit is below the stated noise, which may be overstated; {expected}", True
    return f"misfit agrees with the stated noise; {expected}", False


def render_set(
    result: StoredResult,
    figures: Iterable[tuple[str, str, Figure]],
    trail: Sequence[tuple[str, str]] = (),
    copies: bool = True,
) -> str:
    """The page of one data set as HTML text.

    ``figures``: (name, caption, figure); ``trail``: links (words, address) above them all; ``copies``: whether the
    figures are also kept as PDF and PNG.
    """
    drawn = [(name, caption, inline_svg(figure, f"{ANCHOR}-{name}", caption)) for name, caption, figure in figures]
    page = Page(result)
    return render("set.html.j2", title=result.name, s=page, figures=drawn, anchor=ANCHOR, trail=trail, copies=copies)
