"""A posterior in a few numbers, in display units: for the terminal, ``summary.csv`` and the pages."""

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import pandas as pd

from en4dvar.diagnosis.analysis import Analysis, FieldEstimate
from en4dvar.diagnosis.diagnostics import HARDLY_INFORMED, change_words, member_quantiles
from en4dvar.diagnosis.response.budget import budget_words
from en4dvar.diagnosis.response.what_if import Shift, exclusion, is_manifold
from en4dvar.model.state import Array, Parameter
from en4dvar.plumbing.caution import Caution, codes, of_several_modes, untrusted
from en4dvar.plumbing.hints import counted, percent
from en4dvar.plumbing.tables import table
from en4dvar.plumbing.units import convert, unit_after

MOST_REMARKS = 3
MOST_BRIEF = 4  # parameters in one line
INTERVAL = ("std", "q05", "q50", "q95", "dfs")  # what is not printed where it is not to be trusted
ROUNDING = 1e-12  # of the std: what is left of the mean of members that are centred at 0
LITTLE, AS_WIDE = "data say little", "not narrowed by the data"
FROM_ABOVE = "limited only from above"
MODAL = "of several modes: quantiles, no mean ± std"
DFS_WORDS = (
    (HARDLY_INFORMED, AS_WIDE),
    (0.5, "weakly informed"),
    (0.9, "informed"),
    (math.inf, "determined by the data"),
)


@dataclass(frozen=True)
class ParameterSummary:
    """One row of the summary table; all values in ``unit``, the display unit.

    ``informed`` says what the data told of it; ``untrusted`` are the codes of the warnings for which its interval is
    not to be quoted (:func:`en4dvar.plumbing.caution.untrusted`), worst first. ``modal``: the members come from several
    modes, so that the quantiles are quoted and mean and std are not.
    """

    name: str
    label: str
    symbol: str
    unit: str
    prior_mean: float
    prior_std: float
    mean: float
    std: float
    q05: float
    q50: float
    q95: float
    centre: float
    dfs: float
    informed: str = ""
    untrusted: tuple[str, ...] = ()
    modal: bool = False

    @property
    def middle(self) -> float:
        """The mean; of several modes the median."""
        return self.q50 if self.modal else self.mean

    @classmethod
    def of(
        cls, p: Parameter, prior: Array, posterior: Array, centre: float, dfs: float, cautions: Sequence[Caution]
    ) -> "ParameterSummary":
        """Of members (N',) alive, in the display unit; the centre is SI, ``cautions`` are those of the run."""
        prior_mean, prior_std = _moments(prior)
        mean, std = _moments(posterior)
        q05, q50, q95 = map(float, member_quantiles(posterior, (0.05, 0.5, 0.95)) if posterior.size else (np.nan,) * 3)
        centre = convert(centre, p.unit, p.display_unit)
        words, doubted = informed_words(p.name, dfs, cautions), untrusted(cautions, p.name)
        modal = not doubted and of_several_modes(cautions, p.name)
        numbers = (prior_mean, prior_std, mean, std, q05, q50, q95, centre, dfs)
        return cls(p.name, p.label, p.symbol, p.display_unit, *numbers, MODAL if modal else words, doubted, modal)


def informed_words(name: str, dfs: float, cautions: Sequence[Caution]) -> str:
    """How far the data inform a parameter, in words: by its DFS share and by its diagnoses; "" where it cannot be said.

    That the data say little is for the check of the posterior to find: a variance as large as the prior's does not
    mean it, where the posterior has moved or is not the one reported.
    """
    if dfs != dfs or untrusted(cautions, name):
        return ""
    if any(c.code == "not-informed" and name in c.parameters for c in cautions):
        return LITTLE
    if any(c.code == "upper-limit" and name in c.parameters for c in cautions):
        return FROM_ABOVE
    return next(words for limit, words in DFS_WORDS if dfs < limit or limit == math.inf)


def remarks(a: Analysis) -> tuple[str, ...]:
    """Remarks below the table on the terminal: how far fields are narrowed, whether there is a change in what may vary,
    what the error bars of the path's parameters are made of, how the readings after the window came out, and the
    alternatives that move a parameter beyond its error bar.
    """
    used = len(a.problem.observations.used)
    excluded = {s.name: exclusion(a.fit[0], used, s.misfit_change) for s in a.what_if}
    large = [shift for shift in a.what_if if shift.exceeds and not excluded[shift.name]]
    lines = [f"what if {shift.words}: {_moved(a.parameters, shift)}" for shift in large[:MOST_REMARKS]]
    more = len(large) - len(lines)
    lines += [f"what if {s.words}: {excluded[s.name]}" for s in a.what_if if excluded[s.name]][:MOST_REMARKS]
    if a.log_evidence_change is not None:
        names = " and ".join(change.name for change in a.problem.varying)
        lines.insert(0, change_words(names, a.log_evidence_change))
    if a.withheld is not None:
        share, count = a.withheld.inside, len(a.withheld.values)
        words = f"{percent(share)} of {count} readings lie in their 90 % bands"
        words = f"the only reading lies {'in' if share else 'outside of'} its 90 % band" if count == 1 else words
        lines.insert(0, f"after the window: {words}")
    known = [name for name in a.problem.model.path_parameters if name in a.problem.prior.names]
    if a.settings.what_if == "added":
        rows = counted(sum(shift.settled for shift in a.what_if), "row")
        lines.insert(0, f"the intervals contain {rows} of the what-if table, each as one standard deviation")
    lines[:0] = [words for name in known if (words := budget_words(a, name))]
    lines[:0] = [_narrowed(estimate) for estimate in a.fields]
    return (*lines, *([f"what if: {more} more exceed the error bar, or may; see the report"] if more else []))


def _narrowed(of: FieldEstimate) -> str:
    field, stds = of.prior.field, (math.sqrt(np.mean(std**2)) for std in (of.prior_std, of.std))
    shown = (convert(std, field.unit, field.display_unit) for std in stds)
    before, after = (f"{std:.3g}{unit_after(field.display_unit)}" for std in shown)
    words = f"standard deviation {after} after the readings, {before} before them (root mean square)"
    return f"{field.name} of {counted(field.size, 'cell')}: {words}; see the report"


def _moved(parameters: Iterable[Parameter], shift: Shift) -> str:
    """The parameters beyond their error bar under an alternative."""
    if shift.reason:
        return f"only a fit with it shows the change ({shift.reason})"
    words = []
    for p, change, relative, in_std in zip(parameters, shift.change, shift.relative, shift.in_std, strict=True):
        if abs(in_std) > 1:
            value = f"{convert(float(change), p.unit, p.display_unit):+.2g}{unit_after(p.display_unit)}"
            shown = value if np.isnan(relative) else f"{100 * relative:+.2g} %"
            shown = f"{1 + relative:.2g} times as large" if is_manifold(relative) else shown
            words.append(f"{p.name} {shown} ({abs(in_std):.1f} std)")
    return ", ".join(words)


def results_table(summaries: Mapping[str, Iterable[ParameterSummary]]) -> str:
    """Posterior mean, std and 5/50/95 % of every parameter (data set → its rows).

    Where these are not to be trusted the last column says why.
    """
    every = [(name, row) for name, summary in summaries.items() for row in summary]
    doubted = any(row.untrusted for _, row in every)
    header = ("data set", "parameter", "unit", "mean", "std", "5 %", "50 %", "95 %", *["not to be trusted"] * doubted)
    rows = [
        (name, row.name, row.unit, *estimate_cells(row), *[", ".join(row.untrusted)] * doubted) for name, row in every
    ]
    return table([header, *rows])


class Estimates:
    """Of many data sets: how many tell a parameter, and the median and the middle 90 % of their estimates."""

    def __init__(self) -> None:
        self._counts = Counter[tuple[str, str]]()
        self._values: dict[tuple[str, str], list[float]] = {}

    def add(self, summary: Iterable[ParameterSummary]) -> None:
        """Count a data set in."""
        for row in summary:
            self._counts[row.name, row.unit] += 1
            self._values.setdefault((row.name, row.unit), []).extend([] if row.untrusted else [row.middle])

    def __bool__(self) -> bool:
        return bool(self._counts)

    def __str__(self) -> str:
        lines = [["parameter", "unit", "data sets", "to be trusted", "5 % of them", "median", "95 % of them"]]
        for (name, unit), values in self._values.items():
            quantiles = np.quantile(values, (0.05, 0.5, 0.95)) if values else (np.nan,) * 3
            counts = str(self._counts[name, unit]), str(len(values))
            lines.append([name, unit, *counts, *(f"{value:.4g}" if value == value else "-" for value in quantiles)])
        return table(lines)


def brief(rows: Sequence[ParameterSummary]) -> str:
    """The first parameters in one line, e.g. ``G 0.42 ± 0.12 kPa, mu 0.086 ± 0.005 Pa s and 3 more``."""
    words = []
    for row in rows[:MOST_BRIEF]:
        digits = max(0, 1 - math.floor(math.log10(row.std))) if 0 < row.std < math.inf else 4
        value = f"{row.mean:.{digits}f} ± {row.std:.{digits}f}" if digits < 7 else f"{row.mean:.4g} ± {row.std:.2g}"
        if row.modal:
            value = f"{row.q05:.3g} to {row.q95:.3g}"
        elif row.untrusted:
            value = f"about {row.mean:.2g}"
        words.append(f"{row.name} {value}{unit_after(row.unit)}" + " (not to be trusted)" * bool(row.untrusted))
    more = len(rows) - len(words)
    return ", ".join(words) + (f" and {more} more" if more > 0 else "")


def estimate_cells(row: ParameterSummary) -> tuple[str, ...]:
    """Mean, std, 5, 50 and 95 % for a terminal; a mean of three digits alone where no interval is to be trusted, and
    the quantiles alone of several modes.
    """
    if row.untrusted:
        return (f"{row.mean:.3g}", "-", "-", "-", "-")
    if row.modal:
        return ("-", "-", *(f"{v:.4g}" for v in (row.q05, row.q50, row.q95)))
    return tuple(f"{v:.4g}" for v in (row.mean, row.std, row.q05, row.q50, row.q95))


def summary_rows(
    summaries: Iterable[tuple[str, Iterable[ParameterSummary], Iterable[Caution]]], failures: Mapping[str, str]
) -> Iterator[Sequence[object]]:
    """Rows of ``summary.csv``: one a data set and parameter, every digit kept; one a data set that failed.

    ``summaries``: (name of the data set, its rows, its warnings: column ``warnings`` holds their codes);
    ``failures``: name of the data set → reason, column ``failure``. An interval that is not to be trusted is left out,
    and column ``untrusted`` says for which warnings; so are mean and standard deviation of several modes, which
    ``informed`` says.
    """
    yield ["dataset", *CSV_COLUMNS, "failure", "warnings"]
    for name, summary, cautions in summaries:
        yield from dataset_rows(name, summary, cautions)
    yield from ([name, *("" for _ in CSV_COLUMNS), reason, ""] for name, reason in failures.items())


def dataset_rows(
    name: str, summary: Iterable[ParameterSummary], cautions: Iterable[Caution]
) -> Iterator[Sequence[object]]:
    """Rows of ``summary.csv`` of a data set that has a posterior."""
    warned = " ".join(codes(cautions))
    yield from ([name, *csv_cells(row), "", warned] for row in summary)


CSV_COLUMNS = tuple(f.name for f in fields(ParameterSummary) if f.name not in ("label", "symbol", "modal"))


def csv_cells(row: ParameterSummary) -> list[object]:
    """The row in the order of :data:`CSV_COLUMNS`."""
    hidden = INTERVAL if row.untrusted else ("mean", "std") if row.modal else ()
    cells = {name: "" if name in hidden else getattr(row, name) for name in CSV_COLUMNS}
    return list((cells | {"untrusted": " ".join(row.untrusted)}).values())


def frame(summaries: Mapping[str, Iterable[ParameterSummary]]) -> "pd.DataFrame":
    """A row a data set and parameter, in display units; NaN where a number is not to be quoted."""
    import pandas as pd  # takes long to import

    from en4dvar.plumbing.whole_table import WholeTable

    rows = [[dataset, *csv_cells(row)] for dataset, summary in summaries.items() for row in summary]
    table = WholeTable(rows, columns=["dataset", *CSV_COLUMNS]).set_index(["dataset", "name"])
    numbers = [name for name in table if name not in ("unit", "informed", "untrusted")]
    return table.assign(**{name: pd.to_numeric(table[name]) for name in numbers})


def _moments(values: Array) -> tuple[float, float]:
    if values.size < 2:
        return (float(values[0]) if values.size else np.nan), np.nan
    mean, std = float(values.mean()), float(values.std(ddof=1))
    return (0.0 if abs(mean) < ROUNDING * std else mean), std
