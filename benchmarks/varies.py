"""A viscosity that varies in time, as a campaign of twins: do the bands cover it, and how often is a change reported?

    python benchmarks/varies.py                  60 twins of each kind of truth, about four minutes on one core
    python benchmarks/varies.py --minutes 2      a piece of it: records are kept, the next call goes on
    python benchmarks/varies.py --knots          one knot, 1.9 µs late or in time: how often does the warning come?
    python benchmarks/varies.py --example PATH   readings of one bubble whose viscosity is halved, as a CSV file

A laser bubble in a neo-Hookean solid with rebounds: truths are drawn from the priors of G, μ, R_eq and R_max, the
readings have an error of 1.5 µm, the knots lie at ½, 1, 1½ and 2 times the time of the first collapse. The viscosity
of the truth is drawn from the random walk that the fit assumes (``drawn``), halved at the collapse (``halved``), or
constant. With ``--knots`` it is halved at the collapse, readings have an error of 0.5 µm, and the fit has one knot.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from laser_twin import laser_prior
from records import Record, fill

from en4dvar.data.noise import noise_of
from en4dvar.data.observations import Observations
from en4dvar.diagnosis.analysis import Analysis
from en4dvar.diagnosis.diagnostics import DECISIVE
from en4dvar.estimation.assimilate import assimilate
from en4dvar.priors.varying import PiecewiseModel, RandomWalk
from en4dvar.problem import InverseProblem
from en4dvar.schemes.settings import AssimilationSettings
from en4dvar_bubble.laws import get_law
from en4dvar_bubble.model import BubbleModel

MODEL = BubbleModel(law=get_law("neo-hookean-kelvin-voigt"), start="laser")
PRIOR = laser_prior()
TIMES = np.arange(0.7e-6, 60e-6, 1.4e-6)
NOISE, STD = 1.5e-6, 0.4  # m; of ln μ, of each change
KNOTS = np.array([0.5, 1.0, 1.5, 2.0])  # times that of the first collapse
FINE = np.arange(15e-6, 32e-6, 0.02e-6)
TRUTHS = ("drawn", "halved", "constant")
KNOT_AT, EXACT, OFF = {"1.9 us late": 1.9e-6, "in time": 0.0}, 0.5e-6, 2.0  # s after the collapse; m; of z
SETTINGS = AssimilationSettings(emulator="off", what_if=False)


def changes_of(truth: str, rng: np.random.Generator) -> np.ndarray:
    """Of ln μ at the knots."""
    if truth == "drawn":
        return STD * rng.standard_normal(len(KNOTS))
    return np.where(KNOTS == 1.0, -math.log(2), 0.0) if truth == "halved" else np.zeros(len(KNOTS))


def readings(theta: Mapping[str, np.ndarray], walk: RandomWalk, noise: float, rng: np.random.Generator) -> np.ndarray:
    """(K,) m, of the bubble with the parameters and changes ``theta``, each (1,)."""
    varied = PiecewiseModel(MODEL, [walk])
    (path,) = varied.trajectories(varied.initial_states(theta), TIMES)
    return path["R"] + noise * rng.standard_normal(len(TIMES))


def bubble_of(rng: np.random.Generator) -> tuple[dict[str, np.ndarray], float]:
    """Parameters (1,) drawn from their priors, and the time of the first collapse."""
    values = PRIOR.to_physical(PRIOR.mean + PRIOR.std * rng.standard_normal(len(PRIOR.terms)))
    theta = {name: values[[j]] for j, name in enumerate(PRIOR.names)}
    (path,) = MODEL.trajectories(MODEL.initial_states(theta), FINE)
    return theta, float(FINE[np.argmin(path["R"])])


def fitted(walk: RandomWalk, y: np.ndarray, error: float, what_if: bool, seed: int) -> tuple[Analysis, np.ndarray]:
    """The analysis, and ln μ of its members, a column a piece."""
    observations = Observations(
        TIMES, y, noise_of(np.full(len(TIMES), error), np.zeros(len(TIMES))), np.ones(len(TIMES))
    )
    problem = InverseProblem(MODEL, MODEL.observables[0], observations, PRIOR).varied([walk])
    a = assimilate(problem, replace(SETTINGS, what_if=what_if), seed)
    return a, np.log(a.pieces(walk, a.survivors))


def experiment(key: str) -> Record:
    """Which pieces the bands cover, z-scores of ln μ, and ln of the Bayes factor of a change; of one twin."""
    truth, seed = key.split()
    rng = np.random.default_rng([int(seed), TRUTHS.index(truth)])
    theta, collapse = bubble_of(rng)
    walk = RandomWalk.of(MODEL, PRIOR.terms[1], tuple(collapse * KNOTS), STD)
    changes = changes_of(truth, rng)
    theta |= {f"mu_change_{k}": np.array([change]) for k, change in enumerate(changes, 1)}
    a, pieces = fitted(walk, readings(theta, walk, NOISE, rng), NOISE, False, int(seed))
    true = np.log(walk.pieces(theta)[0])
    low, high = np.quantile(pieces, (0.05, 0.95), axis=0)
    return {
        "covered": ((low <= true) & (true <= high)).tolist(),
        "z": ((pieces.mean(axis=0) - true) / pieces.std(axis=0, ddof=1)).tolist(),
        "log_factor": a.log_evidence_change,
        "width": (high - low).tolist(),
        "warned": bool(a.cautions),
        "runs": a.forward_runs,
    }


def with_one_knot(key: str) -> Record:
    """How far ln μ of the pieces is from its truth, in standard deviations, and what is warned of; of one twin."""
    late, seed = key.rsplit(" ", 1)
    rng = np.random.default_rng([int(seed), 77])
    theta, collapse = bubble_of(rng)
    theta |= {"mu_change_1": np.array([-math.log(2)])}
    true = RandomWalk.of(MODEL, PRIOR.terms[1], (collapse,), STD)
    walk = RandomWalk.of(MODEL, PRIOR.terms[1], (collapse + KNOT_AT[late],), STD)
    a, pieces = fitted(walk, readings(theta, true, EXACT, rng), EXACT, True, int(seed))
    z = (pieces.mean(axis=0) - np.log(true.pieces(theta)[0])) / pieces.std(axis=0, ddof=1)
    return {"z": z.tolist(), "warned": [c.code for c in a.cautions]}


def knots_table(found: Mapping[str, Record]) -> None:
    """Print, for knots late and in time, how many twins are off, and who of them is warned of missed knots."""
    print(f"| the knot | twins | off by {OFF:g} std and more | missed-knots, of these | of the others |\n{'|---' * 5}|")
    for late in KNOT_AT:
        records = [record for key, record in found.items() if key.startswith(late)]
        off = np.array([np.max(np.abs(r["z"])) >= OFF for r in records])
        told = np.array(["missed-knots" in r["warned"] for r in records])
        print(f"| {late} | {len(off)} | {off.sum()} | {(told & off).sum()} | {(told & ~off).sum()} of {(~off).sum()} |")


def write_example(path: Path) -> None:
    """One bubble at the medians of the priors, readings with an error of 0.5 µm, μ halved at 22.4 µs."""
    walk = RandomWalk.of(MODEL, PRIOR.terms[1], (22.4e-6,), STD)
    theta = dict(zip(PRIOR.names, PRIOR.to_physical(PRIOR.mean)[:, None], strict=True))
    radii = readings(theta | {"mu_change_1": np.array([-math.log(2)])}, walk, 0.5e-6, np.random.default_rng(2026))
    head = [
        f"# python benchmarks/varies.py --example {path}",
        "# laser, neo-Hookean: G = 4 kPa, mu = 0.06 Pa s, halved at the first collapse (22.4 us), R_eq = 35 um,",
        "# R_max = 250 um; errors of 0.5 um",
        "t_us,R_um",
    ]
    rows = [f"{1e6 * t:.9g},{1e6 * r:.9g}" for t, r in zip(TIMES, radii, strict=True)]
    path.write_text("\n".join([*head, *rows]) + "\n")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--n", type=int, default=60, help="twins of each kind of truth")
    parser.add_argument("--minutes", type=float, default=np.inf, help="start no twin after so long")
    parser.add_argument("--records", type=Path, default=Path("runs/varies"), help="folder of the records")
    parser.add_argument("--example", type=Path, help="write readings of one twin to this file, and nothing else")
    parser.add_argument("--knots", action="store_true", help="one knot, late or in time")
    parser.add_argument("--start", type=int, default=0, help="first twin")
    options = parser.parse_args()
    if options.example:
        write_example(options.example)
        return
    seeds = range(options.start, options.start + options.n)
    if options.knots:
        keys = [f"{late} {seed}" for seed in seeds for late in KNOT_AT]
        knots_table(fill(options.records / "knots.jsonl", keys, with_one_knot, options.minutes))
        return
    keys = [f"{truth} {seed}" for seed in seeds for truth in TRUTHS]
    found = fill(options.records / "twins.jsonl", keys, experiment, options.minutes)
    print("| truth | twins | pieces covered by 5–95 % | by piece | z mean, std | change reported | constant reported |")
    print("|---|---|---|---|---|---|---|")
    for truth in TRUTHS:
        records = [record for key, record in found.items() if key.startswith(truth)]
        covered, z = (np.array([r[key] for r in records]) for key in ("covered", "z"))
        factors, decisive = np.array([r["log_factor"] for r in records]), math.log(DECISIVE)
        each = ", ".join(f"{100 * share:.0f}" for share in covered.mean(axis=0))
        print(
            f"| {truth} | {len(records)} | {100 * covered.mean():.1f} % | {each} | {z.mean():+.2f}, {z.std():.2f} | "
            f"{100 * np.mean(factors > decisive):.1f} % | {100 * np.mean(factors < -decisive):.1f} % |"
        )


if __name__ == "__main__":
    main()
