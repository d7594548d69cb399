"""A sweep as text; tables 1 and 2 beside the paper's printed values and a twin's truth, as CSV, Markdown and LaTeX."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from en4dvar.plumbing.hints import counted
from en4dvar.plumbing.tables import csv_text
from en4dvar.plumbing.units import convert, unit_after
from en4dvar.report import text
from en4dvar.report.export import column_name, render_latex
from en4dvar.sampling.sweep import SweepResult
from en4dvar_agarose.fits import Fit, Study
from en4dvar_agarose.paper import LABELS, QUANTITIES, ROUTES, TABLES, Quantity, Route

Pair = tuple[float, float]  # mean and standard deviation
Source = Literal["paper", "computed", "truth"]
TITLES: dict[Route, str] = {
    "sweep": "Table 1. IMR sweep: NRMSE-weighted mean ± standard deviation of the best fits",
    "en4dvar": "Table 2. En4D-Var: NRMSE-weighted mean ± standard deviation of the ensemble means",
}
SYNTHETIC = "synthetic twin, no measurement"


@dataclass(frozen=True)
class Cell:
    """One quantity of one model, by source, None where there is none; ``fixed``: not estimated."""

    quantity: Quantity
    pairs: Mapping[Source, Pair | None]
    fixed: bool

    def text(self, source: Source) -> str:
        """Mean and standard deviation; a value that was held fixed has only the first."""
        pair = self.pairs[source]
        return f"{pair[0]:.3g} (fixed)" if self.fixed and pair and source == "computed" else plus_minus(pair)


Row = tuple[Fit, list[Cell]]  # of a gel and a model


def table(study: Study, route: Route) -> list[Row]:
    """The rows of table 1 (``sweep``) or 2 (``en4dvar``), in the units of the paper."""
    rows = []
    for fit in study.every_fit:
        cells = []
        for q in QUANTITIES:
            fixed = q.name in fit.problems[0].fixed
            computed = fit.summary(route, q.name) if fixed or fit.estimated(q.name) else None
            true = study.true_values(fit.gel, q.name) * q.factor
            pairs: dict[Source, Pair | None] = {
                "paper": TABLES[route].get(fit.gel, {}).get(fit.model, {}).get(q.name),
                "computed": (computed[0] * q.factor, computed[1] * q.factor) if computed else None,
                "truth": (float(true.mean()), float(true.std(ddof=1))) if len(true) > 1 else None,
            }
            cells.append(Cell(q, pairs, fixed))
        rows.append((fit, cells))
    return rows


def plus_minus(pair: Pair | None) -> str:
    """``0.420 ± 0.062``; the mean alone without a standard deviation; a dash for None."""
    if pair is None:
        return "–"
    return text.plus_minus(*pair) if pair[1] > 0 else f"{pair[0]:.3g}"


def sources(study: Study) -> dict[Source, str]:
    """The values of a cell, each with its heading."""
    mine = f"this work ({SYNTHETIC})" if study.plan.synthetic else "this work"
    sources: dict[Source, str] = {"paper": "paper", "computed": mine}
    return {**sources, "truth": "truth of the twin"} if study.truth else sources


def as_csv(study: Study, rows: Sequence[Row], route: Route) -> str:
    """One line a gel, model and quantity, every digit kept; a comment says what is synthetic."""
    heads = [f"{source}_{moment}" for source in get_args(Source) for moment in ("mean", "std")]
    lines = [["gel", "model", "quantity", "unit", *heads]]
    for fit, cells in rows:
        for cell in cells:
            values = [value for source in get_args(Source) for value in (cell.pairs[source] or (np.nan, np.nan))]
            numbers = [f"{value:.6g}" if np.isfinite(value) else "" for value in values]
            lines.append([fit.gel, LABELS[fit.model], cell.quantity.name, cell.quantity.unit, *numbers])
    words = f"# {ROUTES[route]} on a SYNTHETIC twin of the paper's campaign; only the paper_ columns are printed\n"
    return f"{words if study.plan.synthetic else ''}{csv_text(lines)}"


def as_text(study: Study, rows: Sequence[Row], route: Route, suffix: Literal["md", "tex"]) -> str:
    """A table in Markdown, a gel and model a line, or in LaTeX, a source a line."""
    units = {"10⁻²": r"$10^{-2}$", "µm": r"$\mu$m", "Pa s": r"Pa\,s"}
    return render_latex(
        f"table.{suffix}.j2", "en4dvar_agarose", title=TITLES[route], synthetic=study.plan.synthetic,
        sources=sources(study), rows=rows, labels=LABELS, quantities=QUANTITIES, units=units,
    )  # fmt: skip


def _estimates(study: Study) -> Iterator[tuple[str, Cell, Pair, Pair]]:
    """Route, gel and law in words, and cell, of everything estimated that the paper prints; computed, then printed."""
    for route in ("sweep", "en4dvar"):
        for fit, cells in table(study, route):
            for cell in cells:
                mine, paper = cell.pairs["computed"], cell.pairs["paper"]
                if paper is not None and mine is not None and not cell.fixed:
                    yield f"{ROUTES[route]}, {fit.gel}, {LABELS[fit.model]}", cell, mine, paper


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
    lines = [f"{head},nrmse_sweep,nrmse_en4dvar,log_evidence".split(",")]
    for fit in study.every_fit:
        of_sets = fit.analyses, fit.nrmse("sweep"), fit.nrmse("en4dvar"), fit.log_evidence
        for q in QUANTITIES:
            if not fit.estimated(q.name):
                continue
            j = fit.prior.names.index(q.name)
            for best, a, *scores in zip(fit.values("sweep", q.name), *of_sets, strict=True):
                x = q.factor * a.posterior[:, j]
                true = study.truth.get(a.name, {}).get(q.name, np.nan) * q.factor
                numbers = [best * q.factor, np.nanmean(x), np.nanstd(x, ddof=1)]
                numbers += [*np.nanquantile(x, (0.05, 0.5, 0.95)), a.dfs_per_parameter[j], true, *scores]
                lines.append([fit.gel, fit.model, a.name, q.name, q.unit, *(f"{v:.6g}" for v in numbers)])
    return csv_text(lines)


def sweep_csv(result: SweepResult) -> str:
    """One line a data set: best fit, time shift, NRMSE."""
    heads = [column_name(p.name, p.display_unit) for p in result.parameters]
    fits = [convert(result.theta[:, j], p.unit, p.display_unit) for j, p in enumerate(result.parameters)]
    columns = result.names, *([f"{v:.6g}" for v in values] for values in fits)
    told = [f"{shift * 1e6:.4g}" for shift in result.shift], [f"{fit:.6f}" for fit in result.nrmse]
    return csv_text([["dataset", *heads, "t_s (us)", "NRMSE"], *zip(*columns, *told, strict=True)])


def sweep_text(result: SweepResult) -> str:
    """NRMSE-weighted mean ± standard deviation of every parameter, and the range of NRMSE."""
    lines = [f"{counted(len(result.names), 'data set')}, {result.trajectories} trajectories"]
    for p, *moments in zip(result.parameters, result.mean, result.std, strict=True):
        mean, std = (convert(float(v), p.unit, p.display_unit) for v in moments)
        value = text.plus_minus(mean, std) if std > 0 else f"{mean:.4g}"
        shown = unit_after(p.display_unit)
        lines.append(f"  {p.label}: {p.name} = {value}{shown}")
    fits = result.nrmse
    return "\n".join([*lines, f"  NRMSE {fits.min():.4f} to {fits.max():.4f}, mean {fits.mean():.4f}"])
