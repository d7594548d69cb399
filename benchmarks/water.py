"""Which physics of gas and vapour gives the rebounds of a bubble in water, of which every constant is known?

    python benchmarks/water.py            the bubble of 1.2 mm in ../shared/data
    python benchmarks/water.py FILE.csv   another: t_us, R_um
    python benchmarks/water.py FILE.csv gilmore equilibrium    only the rows with these words

One number is not known, the amount of gas, as the equilibrium radius R_eq: it is set so that the second oscillation is
as large as measured. The table says how far the largest radii of the third and fourth oscillation, and the instants of
the three, from the first on, are from those measured. Both are read from paths at the instants of the readings: a
parabola through what lies above 0.85 of an oscillation's largest radius. R_max is the measured one.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from en4dvar.model.state import Array
from en4dvar_bubble import WATER_25C, Accuracy, simulate
from en4dvar_bubble.medium import known_medium, saturated_vapour_pressure

DATA = Path(__file__).resolve().parents[2] / "shared" / "data" / "bubbles" / "water" / "water_1200um.csv"
WATER = replace(WATER_25C, rho=known_medium("water").rho, c=known_medium("water").c)
VISCOSITY = 0.89e-3  # Pa s, of water at 25 °C
FINE = Accuracy(nodes=24, medium_nodes=32, rtol=1e-6, step_limit=200_000, time_limit=3600.0)
DIFFUSIVITIES = {"constant": WATER, "kinetic theory": replace(WATER, D_p=1.0, D_T=1.75)}
RATES = (None, 1.0, 0.4, 0.2, 0.1, 0.04)
FULL = {"gas": "heat", "vapour": "transport", "medium_heat": "conducting"}
POLYTROPIC = {"gas": "polytropic", "medium": replace(WATER, p_v=saturated_vapour_pressure(WATER.T_inf))}
Physics = tuple[str, dict[str, object], float | None]
PHYSICS: list[Physics] = [
    (f"polytropic, saturated vapour | – | – | {radial}", {**POLYTROPIC, "radial": radial}, None)
    for radial in ("keller-miksis", "gilmore")
] + [
    (
        f"heat, vapour, warm water | {'equilibrium' if rate is None else rate} | {name} | {radial}",
        {**FULL, "medium": medium, "radial": radial},
        rate,
    )
    for radial in ("keller-miksis", "gilmore")
    for name, medium in DIFFUSIVITIES.items()
    for rate in RATES
]
COUNT = 4
HIGH = 0.85


def tops(times: Array, R: Array) -> Array:
    """(n, 2) instants and largest radii of the oscillations: vertices of parabolas about their maxima."""
    near = 6
    around = [R[max(0, k - near) : k + near + 1] for k in range(len(R))]
    low = [k for k in range(near, len(R) - 1) if R[k] == around[k].min() and R[k] < 0.6 * around[k].max()]
    found = []
    for first, last in zip([0, *low], [*low, len(R)], strict=True):
        t, r = times[first:last], R[first:last]
        high = r > HIGH * r.max()
        if (np.argmax(r) in (0, len(r) - 1) and first > 0) or high.sum() < 3:
            continue
        middle = t[high].mean()
        a, b, c = np.polyfit(t[high] - middle, r[high], 2)
        found.append((middle - b / (2 * a), c - b * b / (4 * a)))
    return np.array(found)


def tops_of(times: Array, R_max: float, R_eq: Array, physics: Physics) -> Array:
    """Tops (n, 4, 2) of paths with these amounts of gas at the instants of the readings, counted from the first top,
    about which a released bubble is symmetric; NaN where there are fewer.
    """
    _, options, rate = physics
    values = {"mu": VISCOSITY, "R_max": R_max, "R_eq": R_eq}
    if rate is not None:
        values["accommodation"] = rate
    after = times[times > 0]
    data = simulate("newtonian", values, after, start="laser", accuracy=FINE, **options)
    found = np.full((len(R_eq), COUNT, 2), np.nan)
    for i, R in enumerate(data.R.values):
        if not data.status[i]:
            own = tops(np.r_[-after[::-1], after], np.r_[R[::-1], R])
            own = own[np.argmin(np.abs(own[:, 0])) :][:COUNT]
            found[i, : len(own)] = own
    return found


def matched(times: Array, observed: Array, physics: Physics) -> tuple[float, Array]:
    """R_eq that gives the second oscillation its size, and the tops (4, 2) with it."""
    wanted, R_eq = np.log(observed[1, 1]), np.geomspace(20e-6, 130e-6, 8)
    for _ in range(3):
        found = tops_of(times, observed[0, 1], R_eq, physics)
        size = np.log(found[:, 1, 1])
        crossing = np.flatnonzero((size[:-1] < wanted) & (size[1:] >= wanted))
        if not len(crossing):
            return np.nan, np.full((COUNT, 2), np.nan)  # always larger
        k = crossing[0]
        best = R_eq[k] * (R_eq[k + 1] / R_eq[k]) ** ((wanted - size[k]) / (size[k + 1] - size[k]))
        R_eq = np.geomspace(R_eq[k], R_eq[k + 1], 4)
    return float(best), tops_of(times, observed[0, 1], np.array([best]), physics)[0]


def main(file: Path, words: Sequence[str] = ()) -> None:
    times, R = np.loadtxt(file, delimiter=",", comments=("#", "t"), unpack=True) * 1e-6
    observed = tops(times, R)[:COUNT]
    told = ", ".join(f"{1e6 * r:.0f} µm at {1e6 * (t - observed[0, 0]):.1f} µs" for t, r in observed)
    print(f"{file.name}: largest radii {told} after the first\n")
    shifted = times - observed[0, 0]
    heads = ["gas", "accommodation", "diffusivity", "radial", "R_eq, µm", "R 3rd", "R 4th", "t 2nd", "t 3rd", "t 4th"]
    print(f"| {' | '.join(heads)} |\n{'|---' * len(heads)}|")
    for physics in PHYSICS:
        if not all(word in physics[0] for word in words):
            continue
        R_eq, found = matched(shifted, observed, physics)
        off = 100 * (found[2:, 1] / observed[2:, 1] - 1), 100 * (found[1:, 0] / (observed[1:, 0] - observed[0, 0]) - 1)
        cells = ["–" if np.isnan(value) else f"{value:+.1f} %" for value in np.concatenate(off)]
        told = f"{1e6 * R_eq:.1f}" if R_eq > 0 else "–"
        print(f"| {physics[0]} | {told} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]) if sys.argv[1:] else DATA, sys.argv[2:])
