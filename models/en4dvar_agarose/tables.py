"""Tables 1 and 2 beside the paper's printed values and a twin's truth, as CSV, Markdown and LaTeX."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from en4dvar_agarose.fits import Study
from en4dvar_agarose.paper import LABELS, QUANTITIES, ROUTES, TABLES, Model, Quantity, Route

Pair = tuple[float, float]
TITLES: dict[Route, str] = {
    "sweep": "Table 1. IMR sweep: NRMSE-weighted mean ± standard deviation of the best fits",
    "en4dvar": "Table 2. En4D-Var: NRMSE-weighted mean ± standard deviation of the ensemble means",
}
SYNTHETIC = "synthetic twin, no measurement"


@dataclass(frozen=True)
class Cell:
    """One quantity of one model: mean and standard deviation, None where there is none; ``fixed``: not estimated."""

    quantity: Quantity
    computed: Pair | None
    printed: Pair | None
    truth: Pair | None
    fixed: bool = False


@dataclass(frozen=True)
class Row:
    """One line of a table."""

    gel: str
    model: Model
    cells: tuple[Cell, ...]


def table(study: Study, route: Route) -> tuple[Row, ...]:
    """The rows of table 1 (``sweep``) or 2 (``en4dvar``), in the units of the paper."""
    rows = []
    for gel, models in study.fits.items():
        for model, fit in models.items():
            printed = TABLES[route].get(gel, {}).get(model, {})
            cells = []
            for q in QUANTITIES:
                pair = fit.summary(route, q.name) if fit.has(q.name) else None
                true = study.true_values(gel, q.name) * q.factor
                cells.append(
                    Cell(
                        q,
                        (pair[0] * q.factor, pair[1] * q.factor) if pair else None,
                        printed.get(q.name),
                        (float(true.mean()), float(true.std(ddof=1))) if len(true) > 1 else None,
                        fixed=fit.has(q.name) and not fit.estimated(q.name),
                    )
                )
            rows.append(Row(gel, model, tuple(cells)))
    return tuple(rows)


def plus_minus(pair: Pair | None, sign: str = "±") -> str:
    """``0.42 ± 0.06``: the standard deviation to two digits, the mean to as many places; a dash for None."""
    if pair is None:
        return "–"
    mean, std = pair
    if not (math.isfinite(std) and std > 0):
        return f"{mean:.3g}"
    places = max(0, 1 - math.floor(math.log10(std)))
    return f"{mean:.{places}f} {sign} {std:.{places}f}"


def text(cell: Cell, pair: Pair | None, sign: str = "±") -> str:
    """A pair of a cell; a value that was held fixed has no standard deviation."""
    return f"{pair[0]:.3g} (fixed)" if cell.fixed and pair and pair is cell.computed else plus_minus(pair, sign)


def columns(study: Study) -> list[tuple[str, str]]:
    """(attribute of a cell, heading) of what stands side by side."""
    mine = f"this work ({SYNTHETIC})" if study.plan.synthetic else "this work"
    found = [("printed", "paper"), ("computed", mine)]
    return [*found, ("truth", "truth of the twin")] if study.truth else found


def as_csv(study: Study, rows: Sequence[Row], route: Route) -> str:
    """One line a gel, model and quantity, every digit kept; a comment says what is synthetic."""
    out = io.StringIO()
    if study.plan.synthetic:
        out.write(
            f"# {ROUTES[route]} on a SYNTHETIC twin of the paper's campaign; only the paper_ columns are printed\n"
        )
    writer = csv.writer(out, lineterminator="\n")
    sources = ("paper", "computed", "truth")
    writer.writerow(["gel", "model", "quantity", "unit", *(f"{s}_{m}" for s in sources for m in ("mean", "std"))])
    for row in rows:
        for cell in row.cells:
            pairs = (cell.printed, cell.computed, cell.truth)
            numbers = [f"{v:.6g}" if np.isfinite(v) else "" for p in pairs for v in (p or (np.nan, np.nan))]
            writer.writerow([row.gel, LABELS[row.model], cell.quantity.name, cell.quantity.unit, *numbers])
    return out.getvalue()


def as_markdown(study: Study, rows: Sequence[Row], route: Route) -> str:
    """A table a gel and model a line, with paper, computed and truth one below the other in a cell."""
    heads = columns(study)
    lines = [f"**{TITLES[route]}**", "", f"In each cell: {'; '.join(h for _, h in heads)}.", ""]
    lines.append("| gel | model | " + " | ".join(f"{q.plain} ({q.unit})" for q in QUANTITIES) + " |")
    lines.append("|---" * (2 + len(QUANTITIES)) + "|")
    for row in rows:
        cells = ["<br>".join(text(cell, getattr(cell, a)) for a, _ in heads) for cell in row.cells]
        lines.append(f"| {row.gel} | {LABELS[row.model]} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def as_latex(study: Study, rows: Sequence[Row], route: Route) -> str:
    """A ``tabular`` in a ``table*`` with booktabs-free rules, one line a source."""
    heads = columns(study)
    caption = TITLES[route].partition(". ")[2].replace("±", r"$\pm$")
    note = (
        " The computed values come from a synthetic twin campaign, not from measurements."
        if study.plan.synthetic
        else ""
    )
    units = {"10⁻²": r"$10^{-2}$", "µm": r"$\mu$m", "Pa s": r"Pa\,s"}
    lines = [r"\begin{table*}", rf"\caption{{{caption}.{note}}}", r"\begin{tabular}{llllll}", r"\hline"]
    names = " & ".join(f"{q.latex} ({units.get(q.unit, q.unit)})" for q in QUANTITIES)
    lines += [rf"Model & Source & {names} \\", r"\hline"]
    gel = ""
    for row in rows:
        if row.gel != gel:
            gel = row.gel
            lines += [rf"\multicolumn{{6}}{{l}}{{{gel.replace('%', chr(92) + '%')} gel}} \\", r"\hline"]
        for i, (attribute, heading) in enumerate(heads):
            cells = [text(cell, getattr(cell, attribute), r"$\pm$").replace("–", "--") for cell in row.cells]
            lines.append(
                rf"{LABELS[row.model] if i == 0 else ''} & {heading.partition(' (')[0]} & {' & '.join(cells)} \\"
            )
        lines.append(r"\hline")
    return "\n".join([*lines, r"\end{tabular}", r"\end{table*}"]) + "\n"


def _estimates(study: Study) -> Iterator[tuple[str, Cell, Pair, Pair]]:
    """Route, gel and law in words, and cell, of everything estimated that the paper prints; computed, then printed."""
    for route in ("sweep", "en4dvar"):
        for row in table(study, route):
            for cell in row.cells:
                if cell.printed is not None and cell.computed is not None and not cell.fixed:
                    yield f"{ROUTES[route]}, {row.gel}, {LABELS[row.model]}", cell, cell.computed, cell.printed


def disagreements(study: Study) -> list[str]:
    """Where the computed mean differs from the printed one by more than both standard deviations together."""
    return [
        f"{where}: {cell.quantity.plain} is {plus_minus(mine)} {cell.quantity.unit} where the paper prints "
        f"{plus_minus(paper)}"
        for where, cell, mine, paper in _estimates(study)
        if abs(mine[0] - paper[0]) > paper[1] + mine[1]
    ]


def spread_notes(study: Study) -> list[str]:
    """Where the standard deviation differs from the printed one by a factor of two or more."""
    ratios = ((where, cell, mine[1] / paper[1]) for where, cell, mine, paper in _estimates(study))
    return [
        f"{where}, {cell.quantity.plain}: {ratio:.2g} times" for where, cell, ratio in ratios if not 0.5 < ratio < 2
    ]


def per_set_csv(study: Study) -> str:
    """One line a gel, model, data set and parameter, in the units of the tables: both routes, truth, fit, DFS."""
    head = "gel,model,dataset,parameter,unit,sweep,en4dvar_mean,en4dvar_std,q05,q50,q95,dfs,truth"
    lines = [f"{head},nrmse_sweep,nrmse_en4dvar,log_evidence"]
    for gel, models in study.fits.items():
        for model, fit in models.items():
            scores = {route: fit.nrmse(route) for route in ("sweep", "en4dvar")}
            for q in QUANTITIES:
                if not fit.estimated(q.name):
                    continue
                j, best = fit.prior.names.index(q.name), fit.values("sweep", q.name)
                for i, (a, evidence) in enumerate(zip(fit.analyses, fit.log_evidence, strict=True)):
                    x = q.factor * a.posterior[:, j]
                    true = study.truth.get(a.name, {}).get(q.name, np.nan) * q.factor
                    numbers = [best[i] * q.factor, np.nanmean(x), np.nanstd(x, ddof=1)]
                    numbers += [*np.nanquantile(x, (0.05, 0.5, 0.95)), a.dfs_per_parameter[j], true]
                    numbers += [scores["sweep"][i], scores["en4dvar"][i], evidence]
                    values = ",".join(f"{v:.6g}" for v in numbers)
                    lines.append(f"{gel},{model},{a.name},{q.name},{q.unit},{values}")
    return "\n".join(lines) + "\n"
