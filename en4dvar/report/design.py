"""The page of compared designs: information against each knob and price, what would be known, what would be seen."""

import math
import re
from collections.abc import Sequence
from dataclasses import replace
from itertools import permutations
from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np

from en4dvar.estimation.design.evaluate import Evaluated
from en4dvar.estimation.design.nested import THIN, Decision
from en4dvar.model.state import Array
from en4dvar.plumbing.hints import counted, free_name
from en4dvar.plumbing.tables import table, write_csv
from en4dvar.plumbing.units import convert, is_unit
from en4dvar.report.chart import PAGE, POINTS, Chart, Panel, Row, in_columns
from en4dvar.report.html import write_page
from en4dvar.report.text import figure_text, pretty_unit, rough_number, unit_behind, with_unit
from en4dvar.results.design_file import DECISION, FILE, DesignRow, Designs, load_designs

TOLD, DRAWN = 12, 6  # designs on the terminal, in the figure of what is seen
WIDE = 46  # letters of a line above a figure
NAMED = 4  # of the designs that cannot be had for the same reason
NOTHING = 0.9  # of the prior's std: a posterior that is wider has learned nothing to speak of
RARELY = 0.1  # share of experiments that decide which law holds, below which none is promised
COARSE = 1.0  # relative std beyond which a percentage says nothing
NUMBER = re.compile(r"\s*([-+]?[\d.]+(?:[eE][-+]?\d+)?)\s*")  # begins the value of a knob; its unit follows
GAINS = "Expected information against what can be turned, each mark a design; bars: Monte Carlo standard errors."
FRONT = "Expected information against price; joined: designs that no other beats in both."
FANS = "Predicted observations: median, 50 % and 90 % of the prior; marks below: the readings that are taken."


def ranked(designs: Designs) -> list[DesignRow]:
    """Those that could be evaluated, the most informative first."""
    return sorted((row for row in designs.rows if row.result), key=lambda row: -row.evaluated.worth)


def front(designs: Designs) -> list[DesignRow]:
    """The designs that no other beats in both price and information (Pareto), the cheapest first."""
    kept: list[DesignRow] = []
    for row in sorted(ranked(designs), key=lambda row: (row.price, -row.evaluated.worth)):
        if not kept or row.evaluated.worth > kept[-1].evaluated.worth:
            kept.append(row)
    return kept


def settings_text(row: DesignRow) -> str:
    return ", ".join(f"{name} {with_pretty_unit(str(it))}" for name, it in row.settings.items()) or "as in the file"


def with_pretty_unit(value: str) -> str:
    """``"1.4 us"`` → ``"1.4 µs"``; what is no number with a unit stays as it is."""
    number = NUMBER.match(value)
    unit = value[number.end() :] if number else ""
    return f"{value[: -len(unit)]}{pretty_unit(unit)}" if unit and is_unit(unit) else value


def words(designs: Designs, row: DesignRow) -> str:
    """What would be known: "G to ± 12 %, alpha hardly at all"."""
    decision, known = row.evaluated.decision, [_known(designs, row, a) for a in range(len(designs.asked.parameters))]
    return ", ".join([*([_law(decision)] if decision else []), *known])


def _law(decision: Decision) -> str:
    if decision.decided < RARELY:
        return f"the law hardly (probability {decision.probability:.2f})"
    return f"the law in {100 * decision.decided:.0f} ± {100 * decision.decided_error:.0f} % of experiments"


def _known(designs: Designs, row: DesignRow, a: int) -> str:
    name, result = designs.asked.parameters[a], row.evaluated
    if result.ratio[a] > NOTHING:
        return f"{name} hardly at all"
    return f"{name} to ± {_spread(float(result.std[a]), float(result.relative[a]), *designs.asked.units[a])}"


def _spread(std: float, relative: float, unit: str, shown: str) -> str:
    """In % of the value where that says something, else in the unit shown."""
    if relative < COARSE:
        return f"{rough_number(100 * relative)} %"
    return f"{rough_number(convert(std, unit, shown))}{unit_behind(shown)}"


def needs(designs: Designs, row: DesignRow) -> list[str]:
    """What others must be known to for what is wanted, a sentence each: "G to ± 5 % if scale were known to 0.3 %"."""
    result = row.evaluated
    if result.needed is None or result.others is None:
        return []
    told = []
    for (name, text), factors in zip(designs.asked.wanted.items(), result.needed, strict=True):
        *each, every = factors.tolist()
        met, alone = every >= 1, [f for f in each if f > 0]
        used = each if met or alone else [every] * len(each)
        known = [
            f"{other} to {_spread(f * std, f * relative if relative < COARSE else math.inf, *units)}"
            for f, (other, *units), std, relative in zip(used, designs.asked.others, *result.others, strict=True)
            if 0 < f < math.inf
        ]
        if not each:
            how = "" if met else ": not with these readings"
        elif met:
            how = f" as long as each is known: {', '.join(known)}" if known else ", however badly each other is known"
        elif alone:
            how = f" if one of these were known better: {', '.join(known)}"
        elif every > 0:
            how = f" if all others were known {rough_number(1 / every)} times better: {', '.join(known)}"
        else:
            how = ": not with these readings, even if all else were known"
        told.append(f"{name} to ± {text}{how}")
    return told


def by(result: Evaluated) -> str:
    """What the information that designs are ranked by was found by."""
    return "nested" if result.decision else result.method


def design_table(designs: Designs) -> str:
    """The best designs and the file's own, for the terminal."""
    rows, own = ranked(designs), [row for row in designs.rows if not row.settings and row.result]
    several = any(row.evaluated.alike > 1 for row in rows)
    gain = "law [nats]" if designs.asked.laws else "gain [nats]"
    head = ("design", *["experiments"] * several, "readings", "price", gain, "by", "what is known")
    cells = [
        (
            settings_text(row), *[str(it.alike)] * several, str(len(it.readings)), f"{row.price:g}",
            f"{it.worth:z.2f} ± {it.worth_error:.2f}", by(it), words(designs, row),
        )
        for row, it in ((row, row.evaluated) for row in dict.fromkeys([*rows[:TOLD], *own]))
    ]  # fmt: skip
    wanted = []
    for row in dict.fromkeys([*rows[:1], *own]):
        alike = f"; {counted(row.evaluated.alike, 'experiment')}" if several else ""
        wanted += [f"{settings_text(row)}{alike}: {text}" for text in needs(designs, row)]
    return "\n".join([table([head, *cells]), *wanted])


def remarks(designs: Designs) -> list[str]:
    failed = [row for row in designs.rows if row.failure]
    rows, told = ranked(designs), []
    if rows and rows[0].evaluated.worth < designs.asked.enough:
        told.append(
            f"the best design is expected to tell {rows[0].evaluated.worth:.2f} nats, less than design.enough = "
            f"{designs.asked.enough:g}: no experiment among these is worth making"
        )
    for reason in dict.fromkeys(row.failure for row in failed):
        names = [settings_text(row) for row in failed if row.failure == reason]
        more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
        told.append(f"{'; '.join(names[:NAMED])}{more}: {reason}")
    worth = [row.evaluated for row in rows]
    stands = sum(it.thin > THIN and it.method != "nested" for it in worth)
    thin = sum(max(it.thin, it.decision.thin if it.decision else 0.0) > THIN for it in worth) - stands
    if thin:
        told.append(f"of {counted(thin, 'design')} the evidences of many readings are rough; raise design.inner")
    if stands:
        few = "too few draws check the linearised information, which stands; raise design.inner"
        told.append(f"of {counted(stands, 'design')} {few}")
    told += [
        f"{settings_text(row)}: {row.evaluated.alike} of these experiments (by {by(row.evaluated)}) cannot tell more "
        f"than {more.evaluated.alike} (by {by(more.evaluated)}): the two are not comparable; set design.method: laplace"
        for row, more in permutations(rows, 2)
        if row.number == more.number
        and row.evaluated.alike < more.evaluated.alike
        and row.evaluated.worth > more.evaluated.worth
    ]
    told += [
        f"{settings_text(row)}: {100 * row.evaluated.beyond:.0f} % of the prior leaves what the model is valid for"
        for row in rows[:TOLD]
        if row.evaluated.beyond > 0.1
    ]
    return told


def gains(designs: Designs) -> Chart:
    names = [*designs.asked.knobs, *["experiments"] * (len({row.evaluated.alike for row in ranked(designs)}) > 1)]
    panels = []
    for name in names:
        rows = [row for row in ranked(designs) if name in row.settings or name == "experiments"]
        x, labels, unit = _positions([row.settings.get(name, row.evaluated.alike) for row in rows])
        worth = np.array([row.evaluated.worth for row in rows])
        errors = np.array([row.evaluated.worth_error for row in rows])
        panel = Panel(with_unit(figure_text(name), unit), "information (nats)", names=labels)
        if labels:
            panel.xticks = range(len(labels))
        panel.bars(x, worth - errors, worth + errors, "posterior", 0.6, 0.7)
        panel.dots(x, worth, "posterior", 3.0, 0.7)
        panels.append(panel)
    below = max((0.12 * len(label) for panel in panels for label in panel.names), default=0.0)
    return in_columns(panels, (5.6 + below) * POINTS, width=PAGE)


def prices(designs: Designs) -> Chart:
    panel = Panel("price", "information (nats)")
    (x, y), (u, v) = (np.array([(row.price, row.evaluated.worth) for row in of(designs)]).T for of in (ranked, front))
    panel.dots(x, y, "prior", 3.0)
    panel.line(u, v, "posterior")
    panel.dots(u, v, "posterior", 4.0)
    return Chart([Row(5.6 * POINTS, [panel])], PAGE)


def fans(designs: Designs) -> Chart:
    """What would be seen with the best designs, and the file's own."""
    rows = [row for row in ranked(designs)[:DRAWN] if row.number]
    rows += [row for row in designs.rows if row.number == 0 and row.result]
    time, value = designs.asked.axes
    panels, several = [], any(row.evaluated.alike > 1 for row in rows)
    same: dict[tuple[int, bytes], list[DesignRow]] = {}
    for row in rows:
        same.setdefault((row.number, row.evaluated.times.tobytes()), []).append(row)
    for row, *others in same.values():
        result = row.evaluated
        t, taken = convert(result.grid, *time), convert(result.times, *time)
        low, lower, middle, upper, high = convert(result.fan, *value)
        worth = [(f"{it.worth:.2f} nats", it.alike) for it in (result, *(other.evaluated for other in others))]
        told = [f"{nats} of {counted(alike, 'experiment')}" if several else nats for nats, alike in worth]
        settings = ", ".join(map(figure_text, settings_text(row).split(", ")))
        title = fill(f"{settings}: {', '.join(told)}", WIDE)
        panel = Panel(with_unit("time", time[1]), with_unit(designs.asked.seen, value[1]), title=title)
        panel.band(t, low, high, "posterior", 0.18)
        panel.band(t, lower, upper, "posterior", 0.3)
        panel.line(t, middle, "posterior")
        bottom, top = panel.limits()[1]
        panel.ylim = bottom - 0.06 * (top - bottom), top
        panel.dots(taken, np.full(len(taken), bottom - 0.01 * (top - bottom)), "centre", 6.0, kind="ticks")
        panels.append(panel)
    return in_columns(panels, 4.4 * POINTS, width=PAGE)


def write_design(folder: Path) -> Path:
    """Write ``design.html`` and ``designs.csv`` from ``design.nc``; returns the page. Raises :class:`OutputError`."""
    designs = load_designs(folder / FILE)
    write_csv(folder / "designs.csv", _cells(designs))
    rows, best, figures = ranked(designs), front(designs), []
    if designs.asked.knobs or len({row.evaluated.alike for row in rows}) > 1:
        figures.append(("gains", GAINS, gains(designs)))
    if len({row.price for row in rows}) > 1:
        figures.append(("prices", FRONT, prices(designs)))
    if all(len(row.evaluated.grid) for row in rows):
        figures.append(("fans", FANS, fans(designs)))
    written = replace(designs, asked=designs.asked.written)
    told = ["; ".join([words(written, row), *needs(written, row)]) for row in best]
    return write_page(
        folder,
        "design",
        figures,
        designs=written,
        by=by,
        rows=[(settings_text(row), row, words(written, row), row in best) for row in rows],
        lab=[(settings_text(row), readings_text(designs, row), row, of) for row, of in zip(best, told, strict=True)],
        remarks=remarks(designs),
    )


def readings_text(designs: Designs, row: DesignRow) -> str:
    """When readings are taken: "43 from 0.7 to 59.5 µs, every 1.4 µs", or each where they are not evenly spaced."""
    stored, shown = designs.asked.axes[0]
    count, unit = len(row.evaluated.times), unit_behind(shown)
    t = np.unique(convert(row.evaluated.times, stored, shown))
    gaps = np.diff(t)
    if len(t) > 2 and np.ptp(gaps) < 1e-6 * gaps.mean():
        return f"{count} from {t[0]:.4g} to {t[-1]:.4g}{unit}, every {gaps.mean():.4g}{unit}"
    return f"{count}, at {', '.join(f'{instant:.4g}' for instant in t)}{unit}"


def _cells(designs: Designs) -> list[list[Any]]:
    """The table as CSV, parameters in their display units."""
    asked, rows = designs.asked, []
    others = [*(name for name, *_ in asked.others), "all"]
    needed = [f"{name}_needs_{other}_factor" for name in asked.wanted for other in others]
    for row in ranked(designs):
        result = row.evaluated
        cells: dict[str, Any] = {"experiments": result.alike, "readings": len(result.readings), "price": row.price}
        cells |= {"gain_nats": result.gain, "gain_error": result.error, "method": result.method}
        cells |= {name: getattr(result.decision, field) for field, (name, _) in DECISION.items() if result.decision}
        for name, (unit, shown), std in zip(asked.parameters, asked.units, result.std.tolist(), strict=True):
            cells[f"{name}_std [{shown}]".removesuffix(" [1]")] = convert(std, unit, shown)
        cells |= {f"{name}_std_ratio": float(x) for name, x in zip(asked.parameters, result.ratio, strict=True)}
        cells |= {"lost": result.lost, "beyond_validity": result.beyond}
        cells |= zip(needed, [] if result.needed is None else result.needed.ravel().tolist(), strict=True)
        taken = {name: free_name(name, cells.keys() | ({*asked.knobs} - {name})) for name in asked.knobs}
        rows.append({column: row.settings.get(name, "") for name, column in taken.items()} | cells)
    return [[*rows[0]], *([*cells.values()] for cells in rows)]


def _positions(values: Sequence[Any]) -> tuple[Array, list[str], str]:
    """Where a knob's values lie on an axis, at numbers of one unit or side by side; labels; the unit."""
    texts = list(map(str, values))
    numbers = [match for match in map(NUMBER.match, texts) if match]
    units = {match.string[match.end() :] for match in numbers}
    if len(numbers) == len(texts) and len(units) == 1:
        return np.array([float(match[1]) for match in numbers]), [], units.pop() or "1"
    names = list(dict.fromkeys(texts))
    return np.array([names.index(text) for text in texts], dtype=float), names, "1"
