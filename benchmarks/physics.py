"""Which physics measured bubbles have: each folder's bubbles are fitted with a list of physics, and each predicts.

    python benchmarks/physics.py ../shared/data/bubbles/*                       every bubble of folders of known names
    python benchmarks/physics.py --minutes 45 --first 3 ../shared/data/bubbles/*    three of each; the next call goes on
    python benchmarks/physics.py --first 3 --page docs/which_physics.md ../shared/data/bubbles/*

Each file goes through ``init`` with the law and medium of its folder; a physics changes that configuration, and nothing
else. Per group and physics are printed: the evidence, readings up to the next minimum after the window in their 90 %
bands and off their medians, all that follow the window likewise, G and μ over the bubbles with χ² of their logarithms
about the weighted mean, and processor time. Evidences are of the same readings, so that their differences count; that
of a pair of physics is over the bubbles that both have. What changes nothing of a bubble, as no wall where ``init``
proposes none, counts as the first row. Records are kept as JSON lines, a line a bubble and physics.
"""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np
from measured_page import GROUPS, after, chi2, intervals
from recordings import commit, verbatim
from records import Record, fill, load

from en4dvar_bubble.starter.physics import SIMPLER

COMMIT = commit()  # when this began
Settings = dict[str, Any]
Change = Callable[[Settings], None]


class _AsFirstError(Exception):
    """A physics changes nothing of what init proposes for a bubble."""


def R_max(settings: Settings) -> float:
    """µm, as init read it."""
    return float(str(settings["parameters"]["R_max"]["mean"]).split()[0])


def polytropic(settings: Settings) -> None:
    settings["model"].update(SIMPLER["laser"])


def accommodation(settings: Settings) -> None:
    settings["parameters"]["accommodation"] = {
        "prior": "logit", "lower": 0.04, "upper": 1, "median": 0.4, "logit_std": 1.2,
    }  # fmt: skip


def wall(settings: Settings) -> None:
    if "wall" not in settings["model"]:
        near, middle, far = (f"{ratio * R_max(settings):.4g} um" for ratio in (1.1, 5, 20))
        settings["model"]["wall"] = {"distance": middle}
        prior = {"prior": "logit", "lower": near, "upper": far, "median": middle, "logit_std": 1.5}
        settings["parameters"]["wall_distance"] = prior


def no_wall(settings: Settings) -> None:
    settings["model"].pop("wall", None)
    settings["parameters"].pop("wall_distance", None)


def slit(settings: Settings) -> None:
    near, middle, far = (f"{ratio * R_max(settings):.4g} um" for ratio in (1.1, 8, 200))
    settings["model"]["wall"] = {"distance": middle, "kind": "slit"}
    prior = {"prior": "logit", "lower": near, "upper": far, "median": middle, "logit_std": 2}
    settings["parameters"]["wall_distance"] = prior


def softening(settings: Settings) -> None:
    settings["model"]["law"] = "softening-kelvin-voigt"
    settings["parameters"]["damage"] = {"prior": "logit", "lower": 0, "upper": 1, "median": 0.3, "logit_std": 1.5}


def scale(settings: Settings) -> None:
    settings["parameters"]["reading_scale"]["log_std"] = 0.05


def gilmore(settings: Settings) -> None:
    settings["model"]["radial"] = "gilmore"


def relaxing(settings: Settings) -> None:
    settings["model"]["law"] = "oldroyd-b"
    settings["parameters"]["mu_p"] = dict(settings["parameters"]["mu"])
    settings["parameters"]["relaxation_time"] = {"prior": "lognormal", "median": "1 us", "log_std": 1.5}


def both(one: Change, other: Change) -> Change:
    def change(settings: Settings) -> None:
        one(settings)
        other(settings)

    return change


PHYSICS: Mapping[str, Change] = {
    "as init proposes": lambda settings: None,
    "polytropic gas": polytropic,
    "finite condensation": accommodation,
    "a wall": wall,
    "no wall": no_wall,
    "a slit": slit,
    "softened gel": softening,
    "scale ± 5 %": scale,
    "relaxing liquid": relaxing,
    "Gilmore, polytropic gas": both(gilmore, polytropic),
    "Gilmore, finite condensation": both(gilmore, accommodation),
}
GELS = ("as init proposes", "polytropic gas", "finite condensation", "a wall", "softened gel")
PEG = (
    "as init proposes", "a slit", "no wall", "a wall", "polytropic gas", "relaxing liquid", "scale ± 5 %",
    "finite condensation",
)  # fmt: skip
WATER = (
    "as init proposes", "polytropic gas", "finite condensation", "a wall", "Gilmore, polytropic gas",
    "Gilmore, finite condensation",
)  # fmt: skip
HEADS = (
    "physics", "bubbles", "ln evidence", "to the next minimum", "off, %", "all after", "off, %", "G, kPa", "χ²",
    "μ, Pa s", "χ²", "s",
)  # fmt: skip


def physics_of(group: str) -> tuple[str, ...]:
    """Names of the physics that bubbles of a group are fitted with, the first of which others are compared with."""
    return GELS if GROUPS[group].law.startswith("neo-hookean") else WATER if group == "water" else PEG


def fitted(file: Path, name: str) -> Record:
    """What ``init``, the change of physics, and ``run`` say of a bubble."""
    group = GROUPS[file.parent.name]
    words = ["--medium", group.medium]

    def change(settings: Settings) -> None:
        before = deepcopy(settings)
        PHYSICS[name](settings)
        if settings == before and name != physics_of(file.parent.name)[0]:
            raise _AsFirstError

    try:
        return {"commit": COMMIT, **verbatim(file.read_text(), group.law, words, quick=False, change=change)}
    except _AsFirstError:
        return {"commit": COMMIT, "as": "first"}


def table(group: str, bubbles: Sequence[str], records: Mapping[str, Record]) -> str:
    """Markdown of a group, a line a physics: of the bubbles that it and the first of the group have records of."""
    names, lines = physics_of(group), [f"| {' | '.join(HEADS)} |", "|---" * len(HEADS) + "|"]
    for name in names:
        both = [b for b in bubbles if {f"{group}/{b}/{name}", f"{group}/{b}/{names[0]}"} <= records.keys()]
        mine, first = ([records[f"{group}/{b}/{of}"] for b in both] for of in (name, names[0]))
        mine = [b if "as" in a else a for a, b in zip(mine, first, strict=True)]
        lines += [f"| {' | '.join([name, *_cells(mine, first)])} |"] * bool(both)
    return "\n".join(lines) + "\n"


def _cells(mine: Sequence[Record], first: Sequence[Record]) -> list[str]:
    told = [r for r in mine if "reason" not in r]
    pairs = [
        (a["log_evidence"], b["log_evidence"]) for a, b in zip(mine, first, strict=True) if "reason" not in {*a, *b}
    ]
    gained = np.array([a - b for a, b in pairs if np.isfinite(a) and np.isfinite(b)])
    better = f", {np.sum(gained > 0)} of {len(gained)}" if np.any(gained) else ""
    cells = [f"{len(told)} of {len(mine)}", f"{gained.sum():+.1f}{better}"]
    for part in ("next", "withheld"):
        count, inside = after(told, part)
        off = [float(r[part][2]) for r in told if r.get(part) and np.isfinite(r[part][2])]
        root = f"{100 * np.sqrt(np.mean(np.square(off))):.1f}" if off else "–"
        cells += [f"{inside:.0%} of {count}" if count else "–", root]
    for key, factor in (("G", 1e3), ("mu", 1.0)):
        logs = intervals(told, key)
        each = np.exp(logs[:, 0]) / factor
        spread = f" ± {each.std(ddof=1):.2g}" if len(each) > 1 else ""
        cells += [f"{each.mean():.3g}{spread}" if len(each) else "–", f"{chi2(logs):.2f}" if len(each) > 1 else "–"]
    seconds = [r["seconds"] for r in told]
    return [*cells, f"{np.median(seconds):.0f}" if seconds else "–"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="+", help="of measured bubbles, of known names")
    parser.add_argument("--first", type=int, help="bubbles of each folder, in the order of their names")
    parser.add_argument("--only", action="append", default=[], metavar="PHYSICS", help="run these alone, any number")
    parser.add_argument("--minutes", type=float, default=np.inf, help="start no bubble after so long")
    parser.add_argument("--records", type=Path, default=Path("runs/physics.jsonl"), help="file of the records")
    parser.add_argument("--page", type=Path, help="write the tables between their marks in this page")
    o = parser.parse_args()
    files = {folder.name: sorted(folder.glob("*.csv"))[: o.first] for folder in o.folders}
    jobs = {
        f"{file.parent.name}/{file.stem}/{name}": (file, name)
        for row in zip_longest(*files.values())  # the first of each group, then the second
        for file in row
        if file is not None
        for name in physics_of(file.parent.name)
    }
    wanted = [key for key, (_, name) in jobs.items() if not o.only or name in o.only]
    fill(o.records, wanted, lambda key: fitted(*jobs[key]), o.minutes)
    records = {key: record for key, record in load(o.records).items() if key in jobs}
    tables = {group: table(group, [file.stem for file in of], records) for group, of in files.items()}
    for group, text in tables.items():
        print(f"{GROUPS[group].title}\n\n{text}")
    if o.page:
        _write(o.page, tables, sorted({r["commit"] for r in records.values()}))


def _write(path: Path, tables: Mapping[str, str], commits: Sequence[str]) -> None:
    command = f"    python {shlex.join(sys.argv)}\n\nCommit {', '.join(commits)}.\n"
    body = "\n".join(f"### {GROUPS[group].title}\n\n{text}" for group, text in tables.items())
    head, rest = path.read_text(encoding="utf-8").split("<!-- physics -->\n")
    path.write_text(
        f"{head}<!-- physics -->\n{command}\n{body}<!-- end -->\n{rest.split('<!-- end -->', 1)[1].lstrip(chr(10))}"
    )


if __name__ == "__main__":
    main()
