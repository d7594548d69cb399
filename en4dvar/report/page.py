"""What the page of one data set says: a result turned into rows, sentences and figures for the template."""

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from en4dvar.diagnosis.diagnostics import chi2_interval
from en4dvar.diagnosis.honesty.checks import MOVED
from en4dvar.estimation.summary import AS_WIDE, ParameterSummary
from en4dvar.plumbing.caution import worst_first
from en4dvar.report import responses
from en4dvar.report.figures import all_figures, neighbours, stored_walks, verdict
from en4dvar.report.history import withheld_words
from en4dvar.report.html import render
from en4dvar.report.responses import exceeding, stored_ledger, stored_shifts
from en4dvar.report.svg import draw
from en4dvar.report.text import number_like, plain_number, range_words, shown
from en4dvar.results.store import StoredResult
from en4dvar.results.variables import ITERATIONS, SHARES

PROVENANCE = (
    "history", "date_created", "seed", "data_source", "git_commit", "configuration_file", "configuration_git_commit",
    "package_versions", "python_version", "platform", "cpu", "institution", "references", "Conventions",
)  # fmt: skip
IDENTIFIERS = "d0-"  # begin those of figures, which are addresses


def render_set(
    result: StoredResult, trail: Sequence[tuple[str, str]] = (), folder: Path | None = None, begin: str = ""
) -> str:
    """The page of one data set as HTML text; ``trail``: links (words, address) above it. ``folder``: where its figures
    are kept as PDF and PNG too, if anywhere, under names with ``begin``.
    """
    judged, recorded = result.group("sample_stats"), json.loads(str(result.attributes["assimilation_settings"]))
    weights = result.of_readings("observed_data", "weights", shared=True)
    total = f"{len(weights)} observations, weights sum to {plain_number(float(weights.sum()))}"
    return render(
        "set.html.j2",
        result=result,
        trail=trail,
        copies=folder is not None,
        stats=judged.attrs,
        rows=result.rows,
        stated=[row.label for row in result.rows if _as_stated(row)],
        lead=[row for row in result.rows if not _as_stated(row)],
        trust=trust(result),
        tiles=_tiles(result),
        shares=_shares(result),
        what_if=(what_if := stored_shifts(result)),
        exceeding=exceeding(what_if),
        what_if_added=recorded.get("what_if") == "added",
        entries=stored_ledger(result),
        readings=responses.reading_words(result),
        withheld=withheld_words(result),
        walks=stored_walks(result),
        verdict=verdict(result),
        identifiers=IDENTIFIERS,
        drawn={name: (caption, svg) for name, caption, svg in draw(all_figures(result), IDENTIFIERS, folder, begin)},
        modes=_modes(result),
        lost=[(i, str(reason)) for i, reason in enumerate(judged["failure_reason"].values.ravel()) if reason],
        iterations=result.group("iterations"),
        diagnostics=[d.name for d in ITERATIONS if not d.scope and d.name != "active"],
        fixed_values=result.group("constant_data").variables.values(),
        settings=[*((key.replace("_", " "), str(value)) for key, value in recorded.items()), ("observations", total)],
        provenance=provenance_rows(result.attributes),
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


def _tiles(result: StoredResult) -> list[tuple[str, str, str, bool]]:
    """(quantity, value, in plain words, needs attention) for the tiles on top."""
    s = result.group("sample_stats").attrs
    alive, members, n_estimated = int(s["n_active"]), int(s["n_members"]), len(result.parameters)
    chi2, dfs, nrmse = (float(s[key]) for key in ("chi2_per_observation", "dfs", "nrmse"))
    structured = any(c.code in ("residual-structure", "odd-residuals") for c in result.cautions)
    chi2_words, chi2_odd = judge_chi2(chi2, int(s["n_weighted"]), dfs, structured)
    rows = result.rows
    shares, doubted = sum(row.dfs for row in rows), any(row.untrusted for row in rows)  # of what is reported
    informed = f"numbers determined by the data, of {n_estimated} estimated: the sum of the shares below"
    if "/fields" in result.groups:
        shares, informed = dfs, "numbers determined by the data, of cells and parameters"
    information = plain_number(shares, 3), informed
    if doubted:
        information = "–", "cannot be told where intervals are not to be trusted"
    ended = "by its own criterion" if s["converged"] else "not converged"
    tiles = [
        ("Fit", number_like(nrmse, 0.01), "NRMSE: 1 is perfect, 0 is no better than a constant", not nrmse >= 0.9),
        ("χ² per observation", plain_number(chi2, 3), chi2_words, chi2_odd),
        ("Information", *information, False),
        ("Members that ran", f"{alive} of {members}", "of the posterior ensemble", alive < members),
        ("Iterations", str(s["n_iterations"]), f"{ended}: {s['stop_reason']}", not s["converged"]),
    ]
    if "n_descents" in s:  # not where the scheme does not search, nor in results of before
        total, agreeing = int(s["n_descents"]), int(s["n_agreeing"])
        words = f"ended in the lowest minimum. {s['descents']}; {s['search_runs']} forward runs looked for another one"
        tiles.append(("Starts that agree", f"{agreeing} of {total}", words, agreeing < 2))
    return tiles


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


def _shares(result: StoredResult) -> list[tuple[str, str, str, list[str]]]:
    """(symbol, std, unit, its parts from errors, discrepancy and prior) of each parameter; parts add in quadrature."""
    if "variance_from_errors" not in result.group("sample_stats"):
        return []
    rows = []
    for row in result.rows:
        shares = [result.of_parameter(f"variance_from_{source}", row.name) for source in SHARES]
        parts = [number_like(row.std * math.sqrt(max(0.0, share)), row.std) for share in shares]
        rows.append((row.symbol, number_like(row.std, row.std), row.unit, parts))
    return rows


def _modes(result: StoredResult) -> list[tuple[str, ...]]:
    """One line a mode: weight, J, descents that ended there, and its centre with 5 to 95 %, in display units."""
    stats = result.group("sample_stats")
    if "mode_cost" not in stats:
        return []
    rows = []
    for k in range(stats.sizes["mode"]):
        of = {key: float(stats[f"mode_{key}"].values[k]) for key in ("weight", "cost", "cost_spread", "descents")}
        centre = []
        for j, (row, v) in enumerate(zip(result.rows, result.parameters.values(), strict=True)):
            keys = ("mode_centre", "mode_q05", "mode_q95")
            at, low, high = (float(shown(v, stats[key].values[k, j])) for key in keys)
            centre.append(f"{number_like(at, row.std)} ({range_words(low, high, row.std)})")
        spread = f" (they were ended within {of['cost_spread']:.2g} of its J)" if of["cost_spread"] else ""
        rows.append((f"{of['weight']:.2f}", f"{of['cost']:.2f}", f"{of['descents']:.0f}{spread}", *centre))
    return rows


def provenance_rows(attributes: Mapping[Any, Any]) -> list[tuple[str, str]]:
    """(what, value) of what a file says of its origin."""
    return [(key.replace("_", " "), str(attributes[key])) for key in PROVENANCE if str(attributes.get(key, ""))]
