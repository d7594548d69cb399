"""What twin experiments and sequences have in common: the page, the rank histogram, and tables for other programs."""

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binom

from en4dvar.model.state import Array
from en4dvar.plumbing.errors import OutputError
from en4dvar.plumbing.files import inside
from en4dvar.plumbing.tables import csv_text
from en4dvar.plumbing.units import convert
from en4dvar.report.chart import POINTS, Chart, Panel, Row
from en4dvar.report.export import Kind, Notes, column_name, escaped, latex_unit, plus_minus, tabular
from en4dvar.report.html import write_page
from en4dvar.report.page import provenance_rows
from en4dvar.report.svg import Captioned, draw
from en4dvar.report.text import with_unit
from en4dvar.results.netcdf import Group, read_groups, understood

Table = tuple[str, Sequence[str], Sequence[Sequence[str]], str]  # heading, columns, rows, words below it
KINDS = ("forecast", "analysis", "smoothed")  # of estimates in time
BINS = 10
CERTAIN = 1e-9  # of its size: the spread of what is known
RANKS = (
    "Rank histogram: where each observation fell among the forecast members, errors of the observations added. A "
    "reliable ensemble has flat bars, 95 % of them inside the band; a valley is too little spread, a hill too much."
)


def write_cycles_page(run_dir: Path, data: Group, figures: Iterable[Captioned], files: bool, **about: Any) -> Path:
    """Write ``report.html``, with ``files`` also figures as PDF and PNG; returns the path of the page.

    ``about``: the ``kind`` of run and ``what`` it is, ``iterations``: forecasts of the window a ``cycle``, on average;
    ``facts`` (quantity, value, in words) for the tiles on top, beside those of scheme, members and forward runs;
    ``tables`` as of :data:`Table`.
    """
    drawn = draw(figures, folder=inside(run_dir, "figures") if files else None)
    about |= {"attributes": data.attrs, "provenance": provenance_rows(data.attrs), "figures": drawn, "copies": files}
    return write_page(run_dir / "report.html", "cycles.html.j2", **about)


def span_of(time: Array) -> tuple[float, float] | None:
    """Limits of an axis of time without margins."""
    return (float(time[0]), float(time[-1])) if time[-1] > time[0] else None


def time_label(data: Group) -> str:
    """Of an axis of time."""
    about = data["time"].attrs
    return with_unit("time", str(about.get("display_units", about["units"])))


def ranks(ranked: Array, members: int) -> Chart:
    """The rank histogram of all observations, with the band that holds 95 % of the bars of a reliable ensemble."""
    known = ranked[np.isfinite(ranked)]
    placed = (members * known + 0.5) / (members + 1)  # of the N + 1 places among N members
    counts, edges = np.histogram(placed, BINS, (0, 1))
    low, high = binom.ppf([0.025, 0.975], len(known), 1 / BINS) / max(1, len(known))
    shares = counts / max(1, len(known))
    panel = Panel("rank of the observation, 0 to 1", f"share of {len(known)}", xlim=(0.0, 1.0))
    panel.ylim = 0.0, 1.05 * max(float(shares.max()), float(high), 1e-3)
    panel.span(low, high, "grid", 0.6)
    panel.stairs(edges, shares, "prior", 0.7)
    panel.rule(1 / BINS, "ink")
    return Chart([Row(5.0 * POINTS, [panel])])


def variables(data: Group) -> list[tuple[str, str, str]]:
    """Name, unit and the unit shown of each variable of the state."""
    columns = "state", "units", "display_units" if "display_units" in data else "units"
    return list(zip(*(map(str, data[column].values) for column in columns), strict=True))


def last_analysis(data: Group) -> Iterator[tuple[str, float, float, str]]:
    """Name, mean, std and the unit they are shown in of the variables that are uncertain at the end."""
    last = (data[f"analysis_{what}"].values[-1].tolist() for what in ("mean", "std"))
    for (name, unit, shown), *numbers in zip(variables(data), *last, strict=True):
        mean, std = (float(convert(number, unit, shown)) for number in numbers)
        if std > CERTAIN * abs(mean):
            yield name, mean, std, shown


def cycles_table(file: Path, kind: Kind) -> str:
    """A table of the result file of a sequence or a twin experiment as text, in display units.

    ``kind``: ``csv``: a line for each time and variable of the state, mean and std of each estimate (and the truth of a
    twin experiment); ``members``: a line for each member and time that is kept; ``latex``: rows of a table (package
    booktabs), mean and std of the last analysis.

    Raises :class:`OutputError`: there is no result, it is damaged, or it holds no members (a twin experiment).
    """
    data = read_groups(file)["/"]
    if kind == "members" and "members" not in data:
        raise OutputError(
            f"{file}: a twin experiment keeps no members; --csv has mean and std of each variable in time"
        )
    with understood(file):
        if kind == "latex":
            return _last_analysis(data)
        return csv_text(_state_members(data) if kind == "members" else _in_time(data))


def _in_time(data: Group) -> Iterator[list[str]]:
    state, every = variables(data), [f"{kind}_{what}" for kind in KINDS for what in ("mean", "std")]
    columns = [column for column in (*every, "truth") if column in data]
    yield ["time", "variable", "unit", *columns]
    values = np.stack([data[column].values * _factors(data) for column in columns], axis=-1)
    for time, at in zip(data["time"].values, values, strict=True):
        for (name, _, unit), row in zip(state, at, strict=True):
            yield [repr(float(time)), name, unit, *(f"{x:.10g}" if np.isfinite(x) else "" for x in row)]


def _state_members(data: Group) -> Iterator[list[str]]:
    yield ["time", "member", *(column_name(name, unit) for name, _, unit in variables(data))]
    for time, members in zip(data["member_time"].values, data["members"].values * _factors(data), strict=True):
        for i, member in enumerate(members):
            if np.isfinite(member).all():  # the others were lost
                yield [repr(float(time)), str(i), *(f"{x:.10g}" for x in member)]


def _factors(data: Group) -> Array:
    """(n,) of the variables of the state, to the units that they are shown in."""
    return np.array([float(convert(1.0, unit, shown)) for _, unit, shown in variables(data)])


def _last_analysis(data: Group) -> str:
    lines = [
        f"{escaped(name)} & {latex_unit(unit) or '--'} & {plus_minus(mean, std)}"
        for name, mean, std, unit in last_analysis(data)
    ]
    head = "% en4dvar export: mean and standard deviation of the last analysis; needs \\usepackage{booktabs}"
    return "\n".join([head, *tabular("llr", "variable & unit & analysis", lines, Notes())]) + "\n"
