"""A page of documentation from folders of measured bubbles: intervals, readings after the window, agreement."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Any

import numpy as np
from records import Record

from en4dvar_bubble.medium import WATER_25C

HEAD = """# Measured bubbles, gel by gel

This page is written by one command from folders of measured radius histories, `t_us,R_um`: each file goes through
`init` and `run` as they are, with the law and the medium of its folder, and no number is adjusted by hand. It is
printed as it comes out, also where that is bad.

    {command}

Commit {commit}: a record stays until it is made again, and later versions may say otherwise (the changelog has what
changed). The data are public, but have no licence that would allow to ship them; where they are from stands
with each group.

How to read it. *G*, *μ*: mean ± standard deviation; a number in brackets has no interval, for the reason that follows
it. *After the window*: how many of the readings that were not fitted lie in the 90 % bands of what was expected of
them, and their distance from the medians in per cent of R_max (rms, root mean square); the window ends at the second
minimum, if there are two. In brackets: 90 % of the shares that as many readings would have if they were what the
estimates expect; the readings of one bubble are missed together, so that shares of few bubbles scatter, mostly
upwards. {chance}

χ² per degree of freedom: of ln G or ln μ about their weighted mean, 1 if bubbles of one gel differ by no more than
their intervals say, and far above 1 if intervals are too narrow or the bubbles' gels differ; the readings after the
window go on to the end of the record, through oscillations of which none was fitted. Density, scale and pressure are
common to the bubbles of a folder and make χ² smaller. Where χ² is far above 1, the stated intervals are too narrow. The
bands allow for gas that a collapse takes or sets free (`gas_change`, see
[physics](physics.md#vapour-and-a-warm-medium)) and, in liquids, for damping that is no viscosity (`viscosity_change`);
where far more than 90 % lie in them, they allow for too much, and where far fewer do, something else happens to the
bubble.
"""
PRESSURE = re.compile(r"ambient pressure of ([\d.]+) ?MPa")
ASKED = 0.85, 0.95  # of the readings up to the next minimum, in bands of 90 %
ATMOSPHERE = 0.1  # MPa, which init takes for granted


@dataclass(frozen=True)
class Group:
    """What is known of a folder: law and medium as ``init`` takes them, and ``words`` of where it is from."""

    title: str
    law: str
    medium: str
    words: str


GROUPS: Mapping[str, Group] = {
    "stiff_polyacrylamide": Group(
        "Stiff polyacrylamide", "neo-hookean-kelvin-voigt", "polyacrylamide",
        "Laser bubbles at 270 000 frames/s (repository IMR_data_assimilation). Published for the gel, with a density "
        "of 1060 kg/m³: G 7.7 ± 1.1 kPa, μ 0.101 ± 0.023 Pa s (Estrada et al. 2018).",
    ),
    "polyacrylamide_1mhz": Group(
        "Polyacrylamide at 1 MHz", "neo-hookean-kelvin-voigt", "polyacrylamide",
        "Laser bubbles at a million frames a second (IMR_data_assimilation).",
    ),
    "paam_alginate": Group(
        "Polyacrylamide–alginate", "neo-hookean-kelvin-voigt", "polyacrylamide-alginate",
        "Laser bubbles at a million frames a second (BubbleDynamicsModel).",
    ),
    "peg_water": Group(
        "PEG 8000 in water", "newtonian", "peg",
        "Laser bubbles at a million frames a second in a liquid (BubbleDynamicsModel); the larger ones end in "
        "fragments.",
    ),
    "water": Group(
        "Water", "newtonian", "water",
        "One bubble of 1.2 mm, and bubbles at ambient pressures up to 45 MPa (LIBDAR), which are stated. μ is known: "
        "0.00089 Pa s at 25 °C.",
    ),
}  # fmt: skip


def stated(text: str) -> dict[str, Any]:
    """What the head of a file says of its experiment: keys of the configuration. Water under pressure is denser (Tait's
    equation) and its sound faster (1.6 m/s a MPa at 25 °C).
    """
    match = PRESSURE.search(text.splitlines()[0])
    if match is None or float(match[1]) == ATMOSPHERE:
        return {}
    p = float(match[1])
    rho = WATER_25C.rho * (1 + 1e6 * p / WATER_25C.tait_B) ** (1 / WATER_25C.tait_n)
    known = {
        "p_inf": (f"{p} MPa", 0.01),
        "rho": (f"{rho:.2f} kg/m^3", 0.001),
        "c": (f"{1497 + 1.6 * p:.1f} m/s", 0.005),
    }
    return {
        f"parameters.{name}": {"prior": "lognormal", "median": median, "log_std": width}
        for name, (median, width) in known.items()
    }


def started(text: str) -> list[str]:
    """What the head of a file says for ``init``: a bubble that a laser makes begins at R_max, however it grew."""
    return ["--start", "laser"] * ("laser" in text.splitlines()[0])


def page(groups: Mapping[str, Sequence[Record]], command: str) -> str:
    """Markdown of all groups by the names of their folders, and of which commits their records are."""
    commits = dict.fromkeys(record["commit"] for records in groups.values() for record in records)
    told = asked_for([counts_of(records, "next") for records in groups.values()])
    chance = (
        f"Were all bands right, every group would have {ASKED[0]:.0%} to {ASKED[1]:.0%} inside up to the next minimum"
    )
    chance += f"\nwith a chance of {told:.1%}."
    parts = [HEAD.format(command=command, commit=", ".join(commits), chance=chance), _overview(groups)]
    parts += [_group(GROUPS[name], records) for name, records in groups.items()]
    return "\n".join(parts)


def _overview(groups: Mapping[str, Sequence[Record]]) -> str:
    lines = [
        "| | bubbles | intervals of G | χ² of ln G | intervals of μ | χ² of ln μ "
        "| readings to the next minimum | inside | all after the window | inside |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    every = [record for records in groups.values() for record in records]
    for title, records in [*((GROUPS[name].title, r) for name, r in groups.items()), ("all", every)]:
        cells = [title, str(len(records))]
        for key in ("G", "mu"):
            logs = intervals(records, key)
            some = any(key in record for record in records)
            cells += [str(len(logs)) if some else "–", f"{chi2(logs):.2f}" if len(logs) > 1 and title != "all" else "–"]
        for part in ("next", "withheld"):
            count, inside = after(records, part)
            chances = np.cumsum(counts_of(records, part))
            low, high = (np.searchsorted(chances, level) / max(1, len(chances) - 1) for level in (0.05, 0.95))
            cells += [str(count), f"{inside:.0%} ({low:.0%} to {high:.0%})" if count else "–"]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def _group(about: Group, records: Sequence[Record]) -> str:
    solid = any("G" in record for record in records)
    head = [
        "bubble",
        *["G, kPa"] * solid,
        "μ, Pa s",
        "to the next minimum",
        "after the window",
        "rms, % of R_max",
        "warnings",
    ]
    lines = [f"## {about.title}", "", about.words + f" Law: `{about.law}`, medium: `{about.medium}`.", ""]
    lines += [f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
    for record in records:
        if "reason" in record:
            lines.append(f"| {record['key']} | {' | '.join(['–'] * (len(head) - 2))} | {record['reason']} |")
            continue
        numbers = [said(record.get("G"), 1e-3)] * solid + [said(record.get("mu"), 1.0)]
        count, share, rms = record["withheld"] or (0, 0.0, 0.0)
        later = [f"{share * count:.0f} of {count}", f"{100 * rms:.1f}"] if count else ["–", "–"]
        first, inside, _ = record["next"] or (0, 0.0, 0.0)
        later = [f"{inside * first:.0f} of {first}" if first else "–", *later]
        lines.append(f"| {' | '.join([record['key'], *numbers, *later, record['warnings']])} |")
    for key, symbol, factor in (("G", "G", 1e-3), ("mu", "μ", 1.0)):
        logs = intervals(records, key)
        if len(logs) > 1:
            each = np.array([factor * r[key]["mean"] for r in records if key in r and not r[key]["untrusted"]])
            spread = f"{each.mean():.3g} ± {each.std(ddof=1):.2g} (standard deviation of the bubbles)"
            told = f"{symbol}: {len(logs)} of {len(records)} intervals; mean {spread}"
            told += f", weighted {factor * average(logs):.3g}"
            lines += ["", f"{told}, χ² of ln {symbol} per degree of freedom {chi2(logs):.2f}."]
    return "\n".join(lines) + "\n"


def intervals(records: Sequence[Record], key: str) -> np.ndarray:
    """Mean and standard deviation of ln θ (n, 2) of the bubbles that have an interval."""
    logs = [record[key]["ln"] for record in records if key in record and not record[key]["untrusted"]]
    return np.array(logs).reshape(-1, 2)


def average(logs: np.ndarray) -> float:
    """θ at the weighted mean of ln θ."""
    mean, std = logs.T
    return float(np.exp(np.sum(mean / std**2) / np.sum(1 / std**2)))


def chi2(logs: np.ndarray) -> float:
    """χ² about the weighted mean per degree of freedom."""
    mean, std = logs.T
    return float(np.sum(((mean - np.log(average(logs))) / std) ** 2) / (len(logs) - 1))


def after(records: Sequence[Record], key: str = "withheld") -> tuple[int, float]:
    """Readings after the windows, or ("next") up to the next minimum, and the share of them in their bands."""
    told = [record[key] for record in records if record.get(key)]
    count = sum(int(each[0]) for each in told)
    return count, sum(each[0] * each[1] for each in told) / max(1, count)


def counts_of(records: Sequence[Record], part: str) -> np.ndarray:
    """Chances that 0, 1, 2, … of all readings of a part (of :func:`after`) lie in their bands, if these are right."""
    return reduce(np.convolve, [record["chances"][part] for record in records if record.get("chances")], np.ones(1))


def asked_for(counts: Sequence[np.ndarray]) -> float:
    """The chance that the shares of all groups are :data:`ASKED`, from each one's :func:`counts_of`."""
    shares = [np.arange(len(of)) / max(1, len(of) - 1) for of in counts]
    return float(np.prod([of[(ASKED[0] <= x) & (x <= ASKED[1])].sum() for of, x in zip(counts, shares, strict=True)]))


def said(number: Record | None, factor: float) -> str:
    """Mean ± standard deviation, or the mean in brackets and why there is no interval."""
    if number is None:
        return "–"
    if number["untrusted"]:
        return f"({factor * number['mean']:.3g}) {number['untrusted']}"
    return f"{factor * number['mean']:.3g} ± {factor * number['std']:.2g}"
