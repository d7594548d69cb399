"""Tables of a run for other programs: CSV of summary or members, LaTeX for a paper.

netCDF needs no export: ``posterior.nc`` follows the ArviZ schema as it is.
"""

import itertools
import re
import string
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined

from en4dvar.config.models import GREEK
from en4dvar.estimation.summary import LITTLE, MODAL, ParameterSummary, summary_rows
from en4dvar.plumbing.caution import Caution, codes
from en4dvar.plumbing.errors import ConfigError
from en4dvar.plumbing.hints import shown, suggest
from en4dvar.plumbing.tables import csv_text
from en4dvar.report.text import GREEK as LETTERS
from en4dvar.report.text import number_like, plain_number, untrusted_words
from en4dvar.results.run_results import RunResults
from en4dvar.results.store import StoredResult

_COMMANDS = (
    f"{GREEK}|mathrm|mathit|mathbf|mathsf|mathcal|rm|it|text|frac|sqrt|hat|bar|tilde|dot|ddot|vec|overline|infty|partial|"
    "nabla|ell|cdot|times|pm|prime|dagger|ast|star|perp|parallel|circ|left|right|langle|rangle|quad|"
    "max|min"
)
_FORMULA = re.compile(rf"\$(?:[A-Za-z0-9_^{{}}()\[\],.+\-*/=' <>|]|\\(?:{_COMMANDS})(?![A-Za-z])|\\[,;:! ])+\$")
Kind = Literal["csv", "latex", "members"]
_ESCAPES = {c: f"\\{c}" for c in "#$%&_{}"} | {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\^{}"}
_ESCAPES |= {"<": r"\textless{}", ">": r"\textgreater{}", "|": r"\textbar{}"}  # other signs in the font of old
_SIGNS = {
    "²": "^2", "³": "^3", "±": r"\pm", "×": r"\times", "−": "-", "→": r"\to", "≤": r"\le", "≥": r"\ge", "≈": r"\approx",
    "√": r"\surd", "°": r"^\circ", "µ": r"\mu", "Ṙ": r"\dot R",
}  # fmt: skip
_ESCAPES |= {c: f"$\\{name}$" for name, c in LETTERS.items()} | {c: f"${sign}$" for c, sign in _SIGNS.items()}
_ESCAPES |= {"–": "--", "—": "---", "…": r"\dots{}"}


def export_table(run_dir: str | Path, kind: Kind = "csv") -> str:
    """A table of a run directory as text, in display units.

    ``kind``: ``csv``: a line for each data set and parameter (prior, mean, std, 5/50/95 %, centre, DFS), every digit
    kept; ``members``: a line for each data set and living posterior member, a column a parameter; ``latex``: for a
    paper (package booktabs) mean ± std, or of a skewed posterior the median with its 5 and 95 %, a row a parameter, or
    of several data sets a row each. Warnings come along: in a column of the CSV, as footnotes in LaTeX, where notes are
    comments. A number that is not to be trusted stands without an interval.

    Raises :class:`ConfigError`: an unknown kind. :class:`OutputError`: the directory holds no results.
    :class:`LackingError`: it lacks some, which are named; ``rest`` is the table of the others.
    """
    if kind not in get_args(Kind):
        raise ConfigError(f"no kind of table is called {shown(kind)}{suggest(kind, get_args(Kind))}")
    stored = RunResults(Path(run_dir))
    results = (result for _, result in stored)  # one is in memory at a time
    rows = ((r.name, r.rows, r.cautions) for r in results)
    if kind == "members":
        text = _members_csv(results)
    elif kind == "latex":
        text = latex_table(sets) if (sets := list(rows)) else ""
    else:
        text = csv_text(summary_rows(rows, {}))
    stored.require(text)
    return text


def _members_csv(results: Iterable[StoredResult]) -> str:
    """Living members; columns that a data set lacks stay empty."""
    lines: list[tuple[object, object, dict[str, float], str]] = []
    header: dict[str, str] = {}
    for result in results:
        for row in result.rows:
            header.setdefault(row.name, column_name(row.name, row.unit))
        warned = " ".join(codes(result.cautions))
        values = {name: result.members("posterior", name) for name in result.parameters}
        for i, member in enumerate(np.flatnonzero(result.alive)):
            lines.append((result.name, member, {name: of[i] for name, of in values.items()}, warned))
    rows = ([name, member, *(own.get(key, "") for key in header), warned] for name, member, own, warned in lines)
    return csv_text([["dataset", "member", *header.values(), "warnings"], *rows])


def column_name(name: str, unit: str) -> str:
    return f"{name} ({unit})" if unit != "1" else name


Found = tuple[str, tuple[ParameterSummary, ...], tuple[Caution, ...]]
LITTLE_NOTE = "the data say little about it: its posterior is close to its prior"
SKEWED_NOTE = "median and 5 to 95 %: the posterior is skewed"
SKEWED = 2.0  # the sides of 48 Gaussian members rarely differ as much
MODAL_NOTE = "5 to 95 % of a posterior of several modes, by their weights"


def latex_table(sets: Sequence[Found]) -> str:
    """Mean ± std for a paper (package booktabs): a row a parameter, or of several ``sets`` a row each."""
    warned = [f"{c.severity}: {name}: {c}" for name, _, cautions in sets for c in cautions if c.kind == "note"]
    comments = ["".join(c if c.isprintable() else " " for c in line) for line in warned]  # which end where they should
    notes = Notes()
    head, rows = _one_set(sets[0], notes) if len(sets) == 1 else _many_sets(sets, notes)
    columns = "llrrr" if len(sets) == 1 else "l" + "r" * (len(head) - 1)
    table = {"columns": columns, "head": head, "rows": rows, "notes": notes, "comments": comments}
    return render_latex("table.tex.j2", what="posterior mean and standard deviation", **table)


def render_latex(template: str, package: str = "en4dvar.report", /, **content: Any) -> str:
    """The text of a template of a package whose marks, ``<% %>`` and ``<< >>``, are not LaTeX's braces."""
    marks, loader = ("<%", "%>", "<<", ">>"), PackageLoader(package, ".")
    environment = Environment(
        *marks, trim_blocks=True, keep_trailing_newline=True, loader=loader, undefined=StrictUndefined
    )
    environment.filters["escaped"] = escaped
    return environment.get_template(template).render(**content)


class Notes(dict[str, str]):
    """The footnotes of a table: the words of each, and its letter, in order of appearance."""

    def mark(self, row: ParameterSummary, cautions: Sequence[Caution]) -> str:
        """What follows a number: the letters of its footnotes, or nothing."""
        words = [{LITTLE: LITTLE_NOTE, MODAL: MODAL_NOTE}.get(row.informed, "")]
        if row.untrusted:
            words = [f"not to be trusted: {untrusted_words(row)}"]
        elif skewed(row) and not row.modal:
            words.append(SKEWED_NOTE)
        return self._marks([*words, *(c.words for c in cautions if row.name in c.parameters and c.kind == "warning")])

    def warn(self, cautions: Sequence[Caution]) -> str:
        """What follows the name of a data set: the letters of the warnings about all of its parameters."""
        return self._marks([c.words for c in cautions if not c.parameters and c.kind == "warning"])

    def _marks(self, each: Sequence[str]) -> str:
        letters = [self.setdefault(words, self._next()) for words in each if words]
        return f"\\textsuperscript{{{','.join(letters)}}}" if letters else ""

    def _next(self) -> str:
        """``a`` … ``z``, then ``aa``, ``ab``, …"""
        rounds, letter = divmod(len(self), 26)
        return (string.ascii_lowercase[rounds - 1] if rounds else "") + string.ascii_lowercase[letter]


def _one_set(dataset: Found, notes: Notes) -> tuple[list[str], list[list[str]]]:
    _, rows, cautions = dataset
    head = ["parameter", "unit", "prior", f"posterior{notes.warn(cautions)}", r"5--95\,\%"]
    return head, [
        [latex_symbol(row), latex_unit(row.unit) or "--", plus_minus(row.prior_mean, row.prior_std),
         _estimate(row, cautions, notes), _interval(row)]
        for row in rows
    ]  # fmt: skip


def _many_sets(sets: Sequence[Found], notes: Notes) -> tuple[list[str], list[list[str]]]:
    first = {row.name: row for _, rows, _ in sets for row in reversed(rows)}
    names = list(dict.fromkeys(row.name for _, rows, _ in sets for row in rows))
    heads = [column_name(latex_symbol(first[n]), latex_unit(first[n].unit) or "1") for n in names]
    lines = []
    for dataset, rows, cautions in sets:
        own, named = {row.name: row for row in rows}, f"{escaped(dataset)}{notes.warn(cautions)}"
        lines.append([named, *(_estimate(own[n], cautions, notes) if n in own else "--" for n in names)])
    return ["data set", *heads], lines


def _estimate(row: ParameterSummary, cautions: Sequence[Caution], notes: Notes) -> str:
    """Mean ± std; of a skewed posterior the median with the distances to its 5 and 95 %; of several modes the interval;
    of what is not to be trusted the mean alone. With the marks of its footnotes."""
    if row.modal:
        value = _interval(row)
    elif row.untrusted:
        value = f"${_tex(plain_number(row.mean, 3))}$"
    elif skewed(row):
        parts = row.q50, row.q95 - row.q50, row.q50 - row.q05
        middle, above, below = (_tex(number_like(part, row.std)) for part in parts)
        value = f"${middle}^{{+{above}}}_{{-{below}}}$"
    else:
        value = plus_minus(row.mean, row.std)
    return f"{value}{notes.mark(row, cautions)}"


def skewed(row: ParameterSummary) -> bool:
    """Whether one side of the 90 % interval is more than twice the other: mean ± std would mislead."""
    below, above = row.q50 - row.q05, row.q95 - row.q50
    return max(below, above) > SKEWED * min(below, above)


def _interval(row: ParameterSummary) -> str:
    if row.untrusted:
        return "--"
    return f"${_tex(number_like(row.q05, row.std))}$ to ${_tex(number_like(row.q95, row.std))}$"


def plus_minus(mean: float, std: float) -> str:
    """In math mode, with the digits that the std calls for."""
    return f"${_tex(number_like(mean, std))} \\pm {_tex(number_like(std, std))}$"


def _tex(number: str) -> str:
    """A number of the report in math mode."""
    text = number.replace("−", "-").replace("–", "\\mbox{--}")
    superscripts = str.maketrans("⁰¹²³⁴⁵⁶⁷⁸⁹⁻", "0123456789-")
    return re.sub(r"×10([⁰¹²³⁴⁵⁶⁷⁸⁹⁻]+)", lambda m: f" \\times 10^{{{m[1].translate(superscripts)}}}", text)


def latex_symbol(row: ParameterSummary) -> str:
    r"""Known commands of mathtext as they are, else text: LaTeX reads and writes files for who asks (``\input``)."""
    return row.symbol if is_math(row.symbol) else escaped(row.symbol)


def is_math(text: str) -> bool:
    r"""Whether ``text`` is one formula between dollars that does nothing but print.

    >>> is_math(r"$\mu_{max}$"), is_math(r"$\frac{1}{2}R^2$"), is_math(r"$\input{x}$"), is_math("$a}b{c$")
    (True, True, False, False)
    """
    depths = list(itertools.accumulate((c == "{") - (c == "}") for c in text))
    return bool(_FORMULA.fullmatch(text)) and min(depths) == 0 == depths[-1]


def latex_unit(unit: str) -> str:
    r"""``"um"`` → ``$\mu$m``, ``"J/m^2"`` → ``J/m$^{2}$``, ``"1"`` → nothing.

    >>> latex_unit("um"), latex_unit("Pa s"), latex_unit("m s-1"), latex_unit("%"), latex_unit("1")
    ('$\\mu$m', 'Pa\\,s', 'm\\,s$^{-1}$', '\\%', '')
    """
    if unit == "1":
        return ""
    text = escaped(unit).replace("\\^{}", "^")
    text = re.sub(r"(?<=[A-Za-z])(?:\^|\*\*)?(-?\d+(?:\.\d+)?)", r"$^{\1}$", text)
    text = re.sub(r"(?<![A-Za-z\\])u(?=[A-Za-z])", r"$\\mu$", text)
    return re.sub(r"\s*\*\s*|\s+", r"\\,", text)


def escaped(text: str) -> str:
    """``text`` as LaTeX prints it, without what cannot be printed."""
    return "".join(_ESCAPES.get(c, c if c.isprintable() else " ") for c in text)
