"""Tables of a run for other programs: CSV of summary or members, LaTeX for a paper.

netCDF needs no export: ``posterior.nc`` follows the ArviZ schema as it is.
"""

from __future__ import annotations

import itertools
import re
import string
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Literal

import numpy as np

from en4dvar.caution import Caution, codes
from en4dvar.config.symbols import GREEK
from en4dvar.errors import OutputError
from en4dvar.report.text import number_like, plain_number, untrusted_words
from en4dvar.storage.store import StoredResult, load_stored, require_settled, result_files
from en4dvar.summary import LITTLE, MODAL, ParameterSummary, summary_csv
from en4dvar.tables import csv_text

_COMMANDS = (
    f"{GREEK}|mathrm|mathit|mathbf|mathsf|mathcal|rm|it|text|frac|sqrt|hat|bar|tilde|dot|ddot|vec|overline|infty|partial|"
    "nabla|ell|cdot|times|pm|prime|dagger|ast|star|perp|parallel|circ|left|right|langle|rangle|quad|"
    "max|min"
)
Kind = Literal["csv", "latex", "members"]
_ESCAPES = {c: f"\\{c}" for c in "#$%&_{}"} | {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\^{}"}


def export_table(run_dir: str | Path, kind: Kind = "csv") -> str:
    """A table of a run directory as text, in display units.

    Parameters
    ----------
    kind: ``csv``: a line for each data set and parameter (prior, mean, std, 5/50/95 %, centre, DFS), every digit kept;
        ``members``: a line for each data set and living posterior member, a column a parameter; ``latex``: mean ± std
        for a paper (package booktabs), a row a parameter, or with several data sets a row a data set.
        Warnings come along: in a column of the CSV, as footnotes and comments in LaTeX. A number that is not to be
        trusted stands without an interval.

    Raises
    ------
    OutputError: the directory holds no results.
    """
    files = result_files(Path(run_dir))
    if not files[0].is_file():
        posterior_file(run_dir)  # says what is missing
    results = map(load_stored, files)  # one is in memory at a time
    if kind == "members":
        return _members_csv(results)
    if kind == "latex":
        return latex_table([(r.name, r.summary(), r.cautions) for r in results])
    return summary_csv(((r.name, r.summary(), r.cautions) for r in results), {})


def posterior_file(run_dir: str | Path) -> Path:
    """The netCDF file of a run or campaign, in the ArviZ schema as it is. Raises :class:`OutputError`."""
    path = Path(run_dir) / "posterior.nc"
    require_settled(path.parent)
    if not path.is_file():
        raise OutputError(f"{run_dir}: holds no posterior.nc; is it the directory of a finished run?")
    return path


def _members_csv(results: Iterable[StoredResult]) -> str:
    """Living members; columns that a data set lacks stay empty."""
    lines: list[tuple[object, object, dict[str, float], str]] = []
    header: dict[str, str] = {}
    for result in results:
        for row in result.summary():
            header.setdefault(row.name, f"{row.name} ({row.unit})" if row.unit != "1" else row.name)
        warned = " ".join(codes(result.cautions))
        values = {str(name): result.members("posterior", str(name)) for name in result.posterior.data_vars}
        for i, member in enumerate(np.flatnonzero(result.alive)):
            lines.append((result.name, member, {name: of[i] for name, of in values.items()}, warned))
    rows = (
        [dataset, member, *(own.get(name, "") for name in header), warned] for dataset, member, own, warned in lines
    )
    return csv_text([["dataset", "member", *header.values(), "warnings"], *rows])


Found = tuple[str, tuple[ParameterSummary, ...], tuple[Caution, ...]]
LITTLE_NOTE = "the data say little about it: its posterior is close to its prior"
MODAL_NOTE = "5 to 95 % of a posterior of several modes, by their weights"


def latex_table(found: Sequence[Found]) -> str:
    """Mean ± std for a paper (package booktabs): a row a parameter, or of several ``found`` a row each."""
    header = "% en4dvar export: posterior mean and standard deviation; needs \\usepackage{booktabs}"
    warned = [f"% {c.severity}: {name}: {c}" for name, _, cautions in found for c in cautions]
    notes = Notes()
    table = _one_set(found[0][1], notes) if len(found) == 1 else _many_sets(found, notes)
    return "\n".join([header, *(_one_line(line) for line in warned), *table]) + "\n"


class Notes:
    """The footnotes of a table: each once, lettered in order of appearance."""

    def __init__(self) -> None:
        self._letters: dict[str, str] = {}

    def mark(self, row: ParameterSummary) -> str:
        """What follows a number: the letter of its footnote, or nothing."""
        words = {LITTLE: LITTLE_NOTE, MODAL: MODAL_NOTE}.get(row.informed, "")
        if row.untrusted:
            words = f"not to be trusted: {untrusted_words(row)}"
        if not words:
            return ""
        letter = self._letters.setdefault(words, string.ascii_lowercase[len(self._letters) % 26])
        return f"\\textsuperscript{{{letter}}}"

    def lines(self, columns: int) -> list[str]:
        """Rows below the table."""
        start = f"  \\multicolumn{{{columns}}}{{l}}{{\\footnotesize "
        return [
            f"{start}\\textsuperscript{{{letter}}} {escaped(words)}}} \\\\" for words, letter in self._letters.items()
        ]


def _one_set(rows: tuple[ParameterSummary, ...], notes: Notes) -> list[str]:
    lines = [
        " & ".join(
            (
                latex_symbol(row),
                latex_unit(row.unit) or "--",
                plus_minus(row.prior_mean, row.prior_std),
                _estimate(row, notes),
                _interval(row),
            )
        )
        for row in rows
    ]
    head = "parameter & unit & prior & posterior & 5--95\\,\\%"
    return tabular("llrrr", head, lines, notes)


def _many_sets(found: Sequence[Found], notes: Notes) -> list[str]:
    first = {row.name: row for _, rows, _ in found for row in reversed(rows)}
    names = list(dict.fromkeys(row.name for _, rows, _ in found for row in rows))
    units = {n: latex_unit(first[n].unit) for n in names}
    head = " & ".join(
        ["data set", *(f"{latex_symbol(first[n])}" + (f" ({units[n]})" if units[n] else "") for n in names)]
    )
    lines = []
    for dataset, rows, _ in found:
        own = {row.name: row for row in rows}
        cells = [_estimate(own[n], notes) if n in own else "--" for n in names]
        lines.append(" & ".join([escaped(dataset), *cells]))
    return tabular("l" + "r" * len(names), head, lines, notes)


def tabular(columns: str, head: str, lines: list[str], notes: Notes) -> list[str]:
    """The lines of a table and of the notes below it."""
    body = [f"  {line} \\\\" for line in lines]
    return [
        f"\\begin{{tabular}}{{{columns}}}", "  \\toprule", f"  {head} \\\\", "  \\midrule", *body,
        "  \\bottomrule", *notes.lines(len(columns)), "\\end{tabular}",
    ]  # fmt: skip


def _estimate(row: ParameterSummary, notes: Notes) -> str:
    """Mean ± std, or the mean alone, or the interval of several modes, with the mark of its footnote."""
    value = f"${_tex(plain_number(row.mean, 3))}$" if row.untrusted else plus_minus(row.mean, row.std)
    if row.modal:
        value = _interval(row)
    return f"{value}{notes.mark(row)}"


def _interval(row: ParameterSummary) -> str:
    if row.untrusted:
        return "--"
    return f"${_tex(number_like(row.q05, row.std))}$ to ${_tex(number_like(row.q95, row.std))}$"


def _one_line(comment: str) -> str:
    """A comment of LaTeX that ends where it should."""
    return "".join(c if c.isprintable() else " " for c in comment)


def plus_minus(mean: float, std: float) -> str:
    """In math mode, with the digits that the std calls for."""
    return f"${_tex(number_like(mean, std))} \\pm {_tex(number_like(std, std))}$"


def _tex(number: str) -> str:
    """A number of the report in math mode."""
    text = number.replace("−", "-").replace("–", "\\mbox{--}")
    superscripts = str.maketrans("⁰¹²³⁴⁵⁶⁷⁸⁹⁻", "0123456789-")
    return re.sub(r"×10([⁰¹²³⁴⁵⁶⁷⁸⁹⁻]+)", lambda m: f" \\times 10^{{{m[1].translate(superscripts)}}}", text)


def latex_symbol(row: ParameterSummary) -> str:
    r"""Matplotlib's mathtext is LaTeX as far as it is letters, indices and known commands; anything else is text.

    A result file may come from anybody, and LaTeX reads and writes files for who asks (``\input``).
    """
    return row.symbol if is_math(row.symbol) else escaped(row.symbol)


def is_math(text: str) -> bool:
    r"""Whether ``text`` is one formula between dollars that does nothing but print.

    >>> is_math(r"$\mu_{max}$"), is_math(r"$\frac{1}{2}R^2$"), is_math(r"$\input{x}$"), is_math("$a}b{c$")
    (True, True, False, False)
    """
    if not re.fullmatch(
        rf"\$(?:[A-Za-z0-9_^{{}}()\[\],.+\-*/=' <>|]|\\(?:{_COMMANDS})(?![A-Za-z])|\\[,;:! ])+\$", text
    ):
        return False
    depths = list(itertools.accumulate((c == "{") - (c == "}") for c in text))
    return min(depths) == 0 == depths[-1]


def latex_unit(unit: str) -> str:
    r"""``"um"`` → ``$\mu$m``, ``"J/m^2"`` → ``J/m$^{2}$``, ``"1"`` → nothing.

    >>> latex_unit("um"), latex_unit("Pa s"), latex_unit("m s-1"), latex_unit("%"), latex_unit("1")
    ('$\\mu$m', 'Pa\\,s', 'm\\,s$^{-1}$', '\\%', '')
    """
    if unit == "1":
        return ""
    text = escaped(unit).replace("\\^{}", "^")
    text = re.sub(r"(?<=[A-Za-z])(?:\^|\*\*)?(-?\d+)", r"$^{\1}$", text)
    text = re.sub(r"(?<![A-Za-z\\])u(?=[A-Za-z])", r"$\\mu$", text)
    return re.sub(r"\s*\*\s*|\s+", r"\\,", text)


def escaped(text: str) -> str:
    """``text`` as LaTeX prints it, without what cannot be printed."""
    return "".join(_ESCAPES.get(c, c if c.isprintable() else " ") for c in text)
