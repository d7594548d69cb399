"""The page of compared designs: information against each knob and price, what would be known, what would be seen."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from en4dvar.design.evaluate import Evaluated
from en4dvar.design.laws import Decision
from en4dvar.files import write_text
from en4dvar.report.html import render
from en4dvar.report.style import LIGHT, PAGE, inline_svg, panels, styled
from en4dvar.report.text import figure_text, rough_number, with_unit
from en4dvar.state import Array
from en4dvar.storage.design_file import DECISION, DesignRow, Designs
from en4dvar.tables import csv_text, table
from en4dvar.units import convert

TOLD, DRAWN = 12, 6  # designs on the terminal, in the figure of what is seen
WIDE = 46  # letters of a line above a figure
NAMED = 4  # of the designs that cannot be had for the same reason
NOTHING = 0.9  # of the prior's std: a posterior that is wider has learned nothing to speak of
RARELY = 0.1  # share of experiments that decide which law holds, below which none is promised
COARSE = 1.0  # relative std beyond which a percentage says nothing
THIN = 0.1  # share of evidences with few effective draws that is told
GAINS = "Expected information against what can be turned, each mark a design; bars: Monte Carlo standard errors."
FRONT = "Expected information against price; joined: the designs that no other beats in both."
FANS = "What would be seen: median, 50 % and 90 % of the prior; marks below: the readings that are taken."


def ranked(found: Designs) -> list[DesignRow]:
    """Those that could be evaluated, the most informative first."""
    return sorted((row for row in found.rows if row.found), key=lambda row: -_worth(row))


def front(found: Designs) -> list[DesignRow]:
    """The designs that no other beats in both price and information (Pareto), the cheapest first."""
    kept: list[DesignRow] = []
    for row in sorted(ranked(found), key=lambda row: (row.price, -_worth(row))):
        if not kept or _worth(row) > _worth(kept[-1]):
            kept.append(row)
    return kept


def settings_text(row: DesignRow) -> str:
    """What the knobs are set to."""
    return ", ".join(f"{name} {value}" for name, value in row.settings.items()) or "as in the file"


def words(found: Designs, row: DesignRow) -> str:
    """What would be known: "G to ± 12 %, alpha hardly at all"."""
    known = [_known(found, row, a) for a in range(len(found.asked.parameters))]
    return ", ".join([*([_law(row.found.decision)] if row.found and row.found.decision else []), *known])


def _law(decision: Decision) -> str:
    """How surely the law will be known."""
    if decision.decided < RARELY:
        return f"the law hardly (probability {decision.probability:.2f})"
    return f"the law in {100 * decision.decided:.0f} ± {100 * decision.decided_error:.0f} % of experiments"


def _known(found: Designs, row: DesignRow, a: int) -> str:
    name, one = found.asked.parameters[a], row.found
    assert one is not None
    if one.ratio[a] > NOTHING:
        return f"{name} hardly at all"
    if one.relative[a] < COARSE:
        return f"{name} to ± {rough_number(100 * float(one.relative[a]))} %"
    unit, shown = found.asked.units[a]
    value = rough_number(float(convert(np.array(one.std[a]), unit, shown)))
    return f"{name} to ± {value}{'' if shown == '1' else f' {shown}'}"


def by(one: Evaluated) -> str:
    """What the information that designs are ranked by was found by."""
    return "nested" if one.decision else one.method


def _gain(found: Designs) -> str:
    return "law [nats]" if found.asked.laws else "gain [nats]"


def design_table(found: Designs) -> str:
    """The best designs and the file's own, for the terminal."""
    rows, own = ranked(found), [row for row in found.rows if not row.settings and row.found]
    told = list({id(row): row for row in (*rows[:TOLD], *own)}.values())
    several = any(row.found.alike > 1 for row in rows if row.found)
    head = ("design", *(["experiments"] if several else []), "readings", "price", _gain(found), "by", "what is known")
    cells = [
        (
            settings_text(row),
            *([str(row.found.alike)] if several else []),
            str(len(row.found.readings)),
            f"{row.price:g}",
            f"{row.found.worth:.2f} ± {row.found.worth_error:.2f}",
            by(row.found),
            words(found, row),
        )
        for row in told
        if row.found
    ]
    return table([head, *cells])


def remarks(found: Designs) -> list[str]:
    """What to know of the designs beside their worth."""
    failed = [row for row in found.rows if row.failure]
    beyond = [row for row in ranked(found)[:TOLD] if row.found and row.found.beyond > 0.1]
    told = []
    if (rows := ranked(found)) and _worth(rows[0]) < found.asked.enough:
        told.append(
            f"the best design is expected to tell {_worth(rows[0]):.2f} nats, less than design.enough = "
            f"{found.asked.enough:g}: no experiment among these is worth making"
        )
    for reason in dict.fromkeys(row.failure for row in failed):
        names = [settings_text(row) for row in failed if row.failure == reason]
        more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
        told.append(f"{'; '.join(names[:NAMED])}{more}: {reason}")
    thin = sum(bool(row.found and row.found.decision and row.found.decision.thin > THIN) for row in found.rows)
    told += [f"of {thin} designs the evidences of many readings are rough; raise design.inner"] if thin else []
    told += [
        f"{settings_text(row)}: {100 * row.found.beyond:.0f} % of the prior leaves what the model is valid for"
        for row in beyond
        if row.found
    ]
    return told


@styled
def gains(found: Designs) -> Figure:
    """Information against each knob."""
    names = [*found.asked.knobs, *(["experiments"] if len({_alike(row) for row in ranked(found)}) > 1 else [])]
    figure, axes = panels(len(names), PAGE, 2.2)
    for ax, name in zip(axes, names, strict=True):
        rows = [row for row in ranked(found) if name in row.settings or name == "experiments"]
        values = [row.settings.get(name, _alike(row)) for row in rows]
        x, labels = _positions(values)
        worth = np.array([_worth(row) for row in rows])
        errors = np.array([row.found.worth_error for row in rows if row.found])
        ax.errorbar(x, worth, errors, fmt="o", ms=3, lw=0.6, color=LIGHT["posterior"], alpha=0.7)
        if labels:
            ax.set_xticks(sorted(set(x)), labels)
        ax.set(xlabel=figure_text(name) + ("" if labels else _unit_of(values)), ylabel="information [nats]")
    return figure


@styled
def prices(found: Designs) -> Figure:
    """Information against price, with the front."""
    figure, (ax,) = panels(1, PAGE, 2.2)
    rows, best = ranked(found), front(found)
    ax.plot([row.price for row in rows], [_worth(row) for row in rows], "o", ms=3, color=LIGHT["prior"])
    ax.plot([row.price for row in best], [_worth(row) for row in best], "o-", ms=4, color=LIGHT["posterior"])
    ax.set(xlabel="price", ylabel="information [nats]")
    return figure


@styled
def fans(found: Designs) -> Figure:
    """What would be seen with the best designs, and the file's own."""
    rows = {row.number: row for row in reversed([*ranked(found)[:DRAWN], *(r for r in found.rows if r.number == 0)])}
    shown = [row for row in reversed(list(rows.values())) if row.found]
    figure, axes = panels(len(shown), PAGE, 1.6)
    time, value = found.asked.axes
    for ax, row in zip(axes, shown, strict=True):
        one = row.found
        assert one is not None
        t, taken = convert(one.grid, *time), convert(one.times, *time)
        low, lower, middle, upper, high = convert(one.fan, *value)
        ax.fill_between(t, low, high, color=LIGHT["posterior"], alpha=0.18, lw=0)
        ax.fill_between(t, lower, upper, color=LIGHT["posterior"], alpha=0.3, lw=0)
        ax.plot(t, middle, color=LIGHT["posterior"])
        ax.plot(taken, np.full(len(taken), 0.03), "|", color=LIGHT["centre"], transform=ax.get_xaxis_transform())
        told = ", ".join(figure_text(f"{name} {value}") for name, value in row.settings.items()) or "as in the file"
        ax.set_title(fill(f"{told}: {_worth(row):.2f} nats", WIDE), fontsize="small")
        ax.set(xlabel=with_unit("time", time[1]), ylabel=with_unit(found.asked.seen, value[1]))
    return figure


def write_design(found: Designs, folder: Path) -> Path:
    """Write ``design.html`` and ``designs.csv``. Returns the path of the page. Raises :class:`OutputError`."""
    write_text(folder / "designs.csv", csv_text(_cells(found)))
    rows, best = ranked(found), {id(row) for row in front(found)}
    drawings = [("fans", FANS, inline_svg(fans(found), "fans", FANS))]
    if len({row.price for row in rows}) > 1:
        drawings.insert(0, ("prices", FRONT, inline_svg(prices(found), "prices", FRONT)))
    if found.asked.knobs or len({_alike(row) for row in rows}) > 1:
        drawings.insert(0, ("gains", GAINS, inline_svg(gains(found), "gains", GAINS)))
    page = render(
        "design.html.j2",
        title="Designs compared",
        sortable=True,
        name=found.attributes.get("name", ""),
        asked=", ".join(found.asked.parameters),
        laws=found.asked.laws,
        by=by,
        rows=[(settings_text(row), row, words(found, row), id(row) in best) for row in rows],
        lab=[(settings_text(row), readings_text(found, row), row, words(found, row)) for row in front(found)],
        remarks=remarks(found),
        drawings=drawings,
        attributes=found.attributes,
    )
    return write_text(folder / "design.html", page)


def readings_text(found: Designs, row: DesignRow) -> str:
    """When readings are taken: "43 from 0.7 to 59.5 µs, every 1.4 µs", or each where they are not evenly spaced."""
    assert row.found is not None
    stored, shown = found.asked.axes[0]
    t, unit = convert(row.found.times, stored, shown), "" if shown == "1" else f" {shown}"
    gaps = np.diff(t)
    if len(t) > 2 and np.ptp(gaps) < 1e-6 * gaps.mean():
        return f"{len(t)} from {t[0]:.4g} to {t[-1]:.4g}{unit}, every {gaps.mean():.4g}{unit}"
    return f"{len(t)}, at {', '.join(f'{one:.4g}' for one in t)}{unit}"


def _cells(found: Designs) -> list[list[Any]]:
    """The table as CSV, parameters in their display units."""
    shown = [unit for _, unit in found.asked.units]
    stds = [
        f"{name}_std" + ("" if u == "1" else f" [{u}]") for name, u in zip(found.asked.parameters, shown, strict=True)
    ]
    head = [*found.asked.knobs, "experiments", "readings", "price", "gain_nats", "gain_error", "method"]
    head += [*([name for name, _ in DECISION.values()] if found.asked.laws else []), *stds]
    ratios = [f"{name}_std_ratio" for name in found.asked.parameters]
    cells = []
    for row in ranked(found):
        one = row.found
        assert one is not None
        units = zip(one.std, found.asked.units, strict=True)
        std = [float(convert(np.array(value), *unit)) for value, unit in units]
        knobs = [row.settings.get(name, "") for name in found.asked.knobs]
        worth = [one.alike, len(one.readings), row.price, one.gain, one.error, one.method]
        worth += [getattr(one.decision, field) for field in DECISION] if one.decision else []
        cells.append([*knobs, *worth, *std, *map(float, one.ratio), one.lost, one.beyond])
    return [[*head, *ratios, "lost", "beyond_validity"], *cells]


def _worth(row: DesignRow) -> float:
    return row.found.worth if row.found else math.nan


def _alike(row: DesignRow) -> int:
    return row.found.alike if row.found else 1


def _positions(values: Sequence[Any]) -> tuple[Array, list[str]]:
    """Where values of a knob lie on an axis: at their numbers, or one beside the other with labels."""
    numbers = [_number(value) for value in values]
    units = {_unit_of([value]) for value in values}
    if len(units) == 1 and None not in numbers:
        return np.array(numbers, dtype=float), []
    names = list(dict.fromkeys(map(str, values)))
    return np.array([names.index(str(value)) for value in values], dtype=float), names


def _number(value: Any) -> float | None:
    found = re.match(r"\s*([-+]?[\d.]+(?:[eE][-+]?\d+)?)", str(value))
    return float(found.group(1)) if found and not isinstance(value, bool) else None


def _unit_of(values: Sequence[Any]) -> str:
    rest = re.sub(r"^\s*[-+]?[\d.]+(?:[eE][-+]?\d+)?\s*", "", str(values[0])) if values else ""
    return f" [{rest}]" if rest else ""
