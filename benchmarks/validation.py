"""The forward model against independent solvers: prints the tables of ``docs/validation.md``.

    python benchmarks/validation.py [oracle] [laser] [suite] [--write docs/validation.md]

``oracle`` needs nothing else; ``laser`` and ``suite`` need the reference trajectories (``--reference FOLDER``). About
five minutes on one core. ``--write`` replaces the tables between the ``<!-- table: NAME -->`` marks of a page.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests" / "bubble"))  # the oracles

from oracle_full import Bubble, Constants  # noqa: E402
from reference_cases import (  # noqa: E402
    ACCURATE,
    LASER,
    NEO_HOOKEAN,
    RADIAL,
    first_rebound,
    laser,
    laser_as_suite_case,
    stored,
    suite,
)
from suite_oracle import CORRECT, Case, Suite  # noqa: E402

from en4dvar_bubble import Accuracy, simulate  # noqa: E402

STRESS = {0: "none", 1: "neo-Hookean", 2: "quadratic", 5: "UCM"}
SWITCHES = {
    "total_pressure_rate": "ṗ of gas and vapour",
    "gilmore_without_factor": "Gilmore factor",
    "inconsistent_conductivity": "conductivity scale",
    "elastic_heating": "elastic heating",
}


def row(*cells: object) -> str:
    return "| " + " | ".join(str(c) for c in cells) + " |"


def head(*cells: str) -> str:
    return row(*cells) + "\n" + row(*("---" for _ in cells))


def oracle(_: Path) -> Iterator[str]:
    """Largest |ΔR|/R_max, and the rebound, as the oracle's grid is refined."""
    times = np.linspace(0, 60e-6, 601)
    yield head("gas", "medium", "oracle's nodes, cells", "max abs ΔR / R_max", "oracle's rebound µm", "our rebound µm")
    grids = ((20, 60), (40, 120), (56, 160))
    cold_wall = ((48, 0), (72, 0), (96, 0))  # takes up nearly all vapour: the most violent collapse
    for vapour, conducting, sizes, finite in (
        ("none", False, grids, {}),
        ("none", True, grids, {}),
        ("frozen", True, grids, {}),
        ("transport", False, cold_wall, {}),
        ("transport", True, grids, {}),
        ("transport", True, grids, {"accommodation": 0.1}),
    ):
        heat = "conducting" if conducting else "cold"
        options = {"start": "laser", "vapour": vapour, "medium_heat": heat, "accuracy": ACCURATE}
        ours = simulate(NEO_HOOKEAN, {**LASER, **finite}, times, **options).R[0].values
        constants, words = Constants(**finite), "".join(f", {key} {value}" for key, value in finite.items())
        for nodes, cells in sizes:
            slow = Bubble(**LASER, vapour=vapour, conducting=conducting, nodes=nodes, cells=cells, constants=constants)
            R = slow.solve(times)
            error = np.abs(R - ours).max() / LASER["R_max"]
            rebounds = [f"{first_rebound(times, x)[0] * 1e6:.2f}" for x in (R, ours)]
            yield row(
                f"vapour: {vapour}{words}", heat, f"{nodes}, {cells if conducting else '–'}", f"{error:.1e}", *rebounds
            )


def laser_cases(reference: Path) -> Iterator[str]:
    """The four laser cases, then case 3 taken apart."""
    z = np.load(reference / "laser.npz")
    t = z["t_s"]
    yield head("", "first rebound µm", "against the reference", "rms ΔR / R_max")
    names = ("cold", "frozen vapour, cold", "frozen vapour, conducting medium", "vapour transport, conducting medium")

    def line(name: str, times: np.ndarray, R: np.ndarray, case: int) -> str:
        expected = z["R_m"][case]
        peak, reference_peak = first_rebound(times, R)[0], first_rebound(t, expected)[0]
        rms = np.sqrt(np.mean((R - expected[: len(R)]) ** 2)) / LASER["R_max"]
        return row(name, f"{peak * 1e6:.2f}", f"{100 * (peak / reference_peak - 1):+.2f} %", f"{rms:.1e}")

    for case, name in enumerate(names):
        peak = first_rebound(t, z["R_m"][case])[0] * 1e6
        yield row(f"case {case} ({name}), reference", f"{peak:.2f}", "", "")
        yield line(f"case {case}, ours", t, laser(case, t), case)
    for nodes, medium_nodes in ((12, 48), (48, 48), (24, 24), (24, 96)):
        R = laser(3, t, Accuracy(nodes=nodes, medium_nodes=medium_nodes, rtol=1e-7))
        yield line(f"case 3, ours, {nodes} and {medium_nodes} nodes", t, R, 3)
    short = t[:601]
    for spurious in (False, True):
        constants = Constants(spurious_wall_temperature=spurious)
        bubble = Bubble(**LASER, vapour="transport", conducting=True, nodes=48, cells=140, constants=constants)
        name = "oracle with the spurious 1/T_wall" if spurious else "oracle"
        yield line(f"case 3, {name}", short, bubble.solve(short), 3)
    for nodes, medium_nodes, spurious in ((50, 50, True), (100, 100, True), (100, 100, False), (200, 400, True)):
        grids = Suite(nodes=nodes, medium_nodes=medium_nodes, spurious_wall_temperature=spurious)
        R = Case(laser_as_suite_case(), grids).solve(short, rtol=1e-6) * LASER["R_max"]
        name = f"the public equations anew, {nodes} and {medium_nodes} nodes"
        yield line(f"case 3, {name}{'' if spurious else ', without the spurious 1/T_wall'}", short, R, 3)


def suite_cases(reference: Path) -> Iterator[str]:
    """All 48 cases: ours against the stored one, and what each departure of the suite contributes."""
    z = np.load(reference / "imr_suite.npz")
    t = z["t_s"]
    yield head(
        "case", "radial", "gas", "medium", "law", "μ", "ours − suite", "suite's equations anew − suite",
        "corrected − ours", "reasons (change of R/R0 when corrected alone)",
    )  # fmt: skip

    def largest(difference: np.ndarray) -> float:
        return float(np.abs(difference).max())

    for i in range(len(z["radial"])):
        c, expected = stored(z, i), z["R_over_R0"][i]
        heat, conducting = bool(c["bubtherm"]), bool(c["medtherm"])
        rtol = 1e-6 if conducting else 1e-7 if heat else 1e-9
        ours = suite(c, t, Accuracy(nodes=48, medium_nodes=48, rtol=1e-8))
        again = Case(c).solve(t, rtol=rtol)
        fine = replace(CORRECT, nodes=48, medium_nodes=71)
        corrected = Case(c, fine).solve(t, rtol=rtol)
        if conducting:  # second order in the medium's grid: extrapolated
            finer = Case(c, replace(fine, medium_nodes=141)).solve(t, rtol=rtol)
            corrected = (4 * finer - corrected) / 3
        reasons = []
        applies = {
            "total_pressure_rate": not heat and c["radial"] != 1,
            "gilmore_without_factor": c["radial"] == 4,
            "inconsistent_conductivity": heat,
            "elastic_heating": conducting and c["stress"] != 0,
        }
        for name, text in SWITCHES.items():
            if applies[name]:
                change = largest(Case(c, replace(Suite(), **{name: False})).solve(t, rtol=rtol) - again)
                reasons.append((change, text))
        if heat:
            coarse = Case(c, replace(CORRECT, differences=True)).solve(t, rtol=rtol)
            reasons.append((largest(coarse - ours), "grid"))
        listed = ", ".join(f"{text} {change:.0e}" for change, text in sorted(reasons, reverse=True))
        yield row(
            i, RADIAL[c["radial"]], "heat" if heat else "polytropic", "conducting" if conducting else "cold",
            STRESS[c["stress"]], f"{c['mu']:g}", f"{largest(ours - expected):.1e}", f"{largest(again - expected):.1e}",
            f"{largest(corrected - ours):.1e}", listed or "none: integration error of the suite",
        )  # fmt: skip


TABLES = {"oracle": oracle, "laser": laser_cases, "suite": suite_cases}


def replace_table(page: Path, name: str, lines: list[str]) -> None:
    """Put ``lines`` between the marks of table ``name``. Raises ValueError where the page has none."""
    before, start, rest = page.read_text().partition(f"<!-- table: {name} -->\n")
    _, end, after = rest.partition("<!-- end -->")
    if not start or not end:
        raise ValueError(f"{page} has no marks for the table {name}")
    page.write_text(before + start + "\n".join(lines) + "\n" + end + after)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("tables", nargs="*", metavar="TABLE", help=f"{', '.join(TABLES)}; all by default")
    parser.add_argument("--reference", type=Path, default=ROOT.parent / "shared" / "reference")
    parser.add_argument("--write", type=Path, help="page whose tables are replaced")
    arguments = parser.parse_args()
    unknown = [name for name in arguments.tables if name not in TABLES]
    if unknown:
        parser.error(f"no such table: {', '.join(unknown)} (there are {', '.join(TABLES)})")
    for name in arguments.tables or TABLES:
        if name != "oracle" and not arguments.reference.is_dir():
            parser.error(f"{name}: no reference trajectories in {arguments.reference}")
        lines = []
        print(f"\n{name}")
        for text in TABLES[name](arguments.reference):
            print(text, flush=True)
            lines.append(text)
        if arguments.write:
            replace_table(arguments.write, name, lines)


if __name__ == "__main__":
    main()
