"""What the page of one data set says: a result turned into rows, sentences and figures for the template."""

import json
import math
from collections.abc import Sequence
from pathlib import Path

from en4dvar.diagnosis.diagnostics import chi2_interval
from en4dvar.diagnosis.honesty.checks import MOVED
from en4dvar.estimation.summary import AS_WIDE, ParameterSummary
from en4dvar.plumbing.caution import worst_first
from en4dvar.report import responses
from en4dvar.report.figures import all_figures, neighbours, stored_walks, verdict
from en4dvar.report.html import render
from en4dvar.report.responses import exceeding, stored_ledger, stored_shifts
from en4dvar.report.svg import draw
from en4dvar.report.text import plain_number
from en4dvar.results.store import StoredResult
from en4dvar.results.variables import ITERATIONS, SHARES

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
        chi2_words=judge_chi2(chi2, int(stats["n_weighted"]), dfs, structured),
        shares=SHARES if "variance_from_errors" in judged else (),
        what_if=(what_if := stored_shifts(result)),
        exceeding=exceeding(what_if),
        entries=stored_ledger(result),
        readings=responses.reading_words(result),
        walks=stored_walks(result),
        verdict=verdict(result),
        identifiers=IDENTIFIERS,
        drawn={name: (caption, svg) for name, caption, svg in draw(all_figures(result), IDENTIFIERS, folder, begin)},
        judged=judged,
        lost=[(i, str(reason)) for i, reason in enumerate(judged["failure_reason"].values.ravel()) if reason],
        iterations=result.group("iterations"),
        diagnostics=[d.name for d in ITERATIONS if not d.scope and d.name != "active"],
        fixed_values=result.group("constant_data").variables.values(),
        settings=recorded,
        weights=result.of_readings("observed_data", "weights", shared=True),
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
    if moved := len(exceeding(stored_shifts(result))):
        which = "one assumption matters" if moved == 1 else f"{moved} assumptions matter"
        words += f" The numbers hold for what was assumed: {which} by more than an error bar, see below."
    return words


def _neighbours_words(result: StoredResult) -> str:
    """Whether neighbouring residuals are related more than independent errors are in 95 of 100 data sets."""
    correlation, limit = neighbours(responses.whitened(result))
    if not len(correlation) or abs(correlation[0]) <= limit:
        return " and neighbouring residuals are unrelated" if len(correlation) else ""
    alike = "resemble each other" if correlation[0] > 0 else "alternate in sign"
    return f", but neighbouring residuals {alike} (correlation {plain_number(float(correlation[0]), 2)}): look at them"


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
    if chi2 * n_observations < low:
        return f"misfit is below the stated noise, which may be overstated; {expected}", True
    if structured:
        return f"the size of the misfit is as stated, its structure is not; {expected}", True
    return f"misfit agrees with the stated noise; {expected}", False
