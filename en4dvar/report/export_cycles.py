"""Tables of runs of cycles, twin experiments and sequences, for other programs: CSV in time or of members, LaTeX."""

from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import numpy as np

from en4dvar.model.state import Array
from en4dvar.plumbing.errors import OutputError
from en4dvar.plumbing.tables import csv_text
from en4dvar.plumbing.units import convert
from en4dvar.report.cycles import last_analysis
from en4dvar.report.export import Notes, escaped, latex_unit, plus_minus, tabular
from en4dvar.results.netcdf import Group, understood
from en4dvar.results.series_file import read_series

KINDS = ("forecast", "analysis", "smoothed")


def cycles_table(file: Path, kind: Literal["csv", "latex", "members"]) -> str:
    """A table of a result file as text, in display units.

    Parameters
    ----------
    kind: ``csv``: a line for each time and variable of the state, mean and std of each estimate (and the truth of a
        twin experiment); ``members``: a line for each member and time that is kept; ``latex``: rows of a table
        (package booktabs), mean and std of the last analysis.

    Raises
    ------
    OutputError: there is no result, it is damaged, or it holds no members (a twin experiment).
    """
    data = read_series(file)
    if kind == "members" and "members" not in data:
        raise OutputError(
            f"{file}: a twin experiment keeps no members; --csv has mean and std of each variable in time"
        )
    with understood(file):
        return _latex(data) if kind == "latex" else csv_text(_members(data) if kind == "members" else _in_time(data))


def _shown(data: Group) -> tuple[list[str], list[str], Array]:
    """Names of the variables, the units they are shown in, and the factors (n,) to these."""
    units = [str(unit) for unit in data["units"].values]
    shown = [str(unit) for unit in data["display_units"].values] if "display_units" in data else units
    factors = [float(convert(1.0, unit, to)) for unit, to in zip(units, shown, strict=True)]
    return [str(name) for name in data["state"].values], shown, np.array(factors)


def _in_time(data: Group) -> Iterator[list[str]]:
    names, units, factors = _shown(data)
    columns = [f"{kind}_{what}" for kind in KINDS for what in ("mean", "std") if f"{kind}_{what}" in data]
    columns += ["truth"] * ("truth" in data)
    yield ["time", "variable", "unit", *columns]
    values = np.stack([data[column].values * factors for column in columns], axis=-1)
    for time, at in zip(data["time"].values, values, strict=True):
        for name, unit, row in zip(names, units, at, strict=True):
            yield [repr(float(time)), name, unit, *(f"{x:.10g}" if np.isfinite(x) else "" for x in row)]


def _members(data: Group) -> Iterator[list[str]]:
    names, units, factors = _shown(data)
    header = [f"{name} ({unit})" if unit != "1" else name for name, unit in zip(names, units, strict=True)]
    yield ["time", "member", *header]
    for time, members in zip(data["member_time"].values, data["members"].values * factors, strict=True):
        for i, member in enumerate(members):
            if np.isfinite(member).all():  # the others were lost
                yield [repr(float(time)), str(i), *(f"{x:.10g}" for x in member)]


def _latex(data: Group) -> str:
    lines = [
        f"{escaped(name)} & {latex_unit(unit) or '--'} & {plus_minus(mean, std)}"
        for name, mean, std, unit in last_analysis(data)
    ]
    head = "% en4dvar export: mean and standard deviation of the last analysis; needs \\usepackage{booktabs}"
    return "\n".join([head, *tabular("llr", "variable & unit & analysis", lines, Notes())]) + "\n"
