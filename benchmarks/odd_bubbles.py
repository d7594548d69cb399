"""Campaigns of bubbles through ``init`` and ``run`` of which one is odd: is it named, and what of the gel's number?

    python benchmarks/odd_bubbles.py [--n 40] [--seed 1] [--bubbles 12] [--spread 0.2] [--liquid] [--minutes 9]

Synthetic laser bubbles of one gel about 8 kPa and 0.1 Pa s, whose G and μ differ by ``--spread``; its density, pressure
and pixel are off by draws of what ``init`` knows of them. Each is filmed at 270 kHz with errors of 0.5 % of R_max and
becomes a file. What ``init`` proposes of the twelve is run as it is but for an isothermal gas, in truth and fit, which
costs a twentieth. The first bubble is as it is (``clean``), of four times the modulus, of a gel that stiffens (α 0.5),
of another gel (soft polyacrylamide), its radii (``scale``) or its times (``clock``) 8 % too large. Each is estimated
once, and the populations with each as the first of the twelve are made of them as ``run`` makes them. *Can be named* is
by a test that is told how much bubbles differ: χ² of how far the first one's ln G and ln μ lie from the mean of the
others, beyond what 5 % of clean campaigns exceed.

``--liquid``: a liquid of about 0.02 Pa s instead, whose first bubble has four times the viscosity; no law differs.
"""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from click.testing import CliRunner
from records import Record, fill
from scipy.stats import chi2
from wrong_worlds import Wrong

import en4dvar
from en4dvar.cli import main as command_line
from en4dvar.config import load_config
from en4dvar.estimation.population import Effort, HyperPrior
from en4dvar.estimation.population.campaign import population_from, sampled_sets, terms_of
from en4dvar.runs.finished import finished

KINDS = ("clean", "gel", "law", "other", "scale", "clock")
QUICK = {"gas": "isothermal", "vapour": "none", "medium_heat": "cold", "vapour_pressure": "saturated"}
NEO, STIFFENING = Wrong(), Wrong(law="quadratic-kelvin-voigt", of_law={"alpha": lambda truth: 0.5})
OFF, OTHER = 1.08, {"G": 2.1 / 7.7, "mu": 0.118 / 0.101}  # soft over stiff polyacrylamide (Estrada et al. 2018)
GEL, LIQUID, OF_GEL = {"G": 8e3, "mu": 0.1}, {"mu": 0.02}, 0.3  # and how far the gels of campaigns differ, ln
NEWTONIAN = Wrong(fitted="newtonian")
RATE, NOISE, BEFORE, CELLS = 270e3, 0.005, 4, 4000  # frames a second, of R_max, frames of the growth, of the path
ATMOSPHERE, DENSITY, SOUND = (101.3, 0.01), (1030.0, 0.017), (1510.0, 0.015)  # as init proposes them
PIXEL, RATIO = 0.005, (6.0, 12.0)  # std of the pixel, and R_max over R_eq


def film(truth: dict[str, float], constants: dict[str, str], kind: str, rng: np.random.Generator) -> str:
    """The file of a bubble, read as one of a ``kind``."""
    liquid = "G" not in truth
    factors = {"gel": {"mu" if liquid else "G": 4.0}, "other": OTHER}.get(kind, {})
    truth = {name: value * factors.get(name, 1.0) for name, value in truth.items()}
    world = NEWTONIAN if liquid else STIFFENING if kind == "law" else NEO
    t = (np.arange(-BEFORE, 40) + rng.random()) / RATE
    path = np.linspace(0.0, t[-1], CELLS)
    radius = world.radius(world.model(truth, QUICK, constants), truth, path)
    assert radius is not None
    read = np.interp(np.abs(t), path, radius) + NOISE * radius[0] * rng.standard_normal(len(t))
    wide, slow = (OFF if kind == name else 1.0 for name in ("scale", "clock"))
    rows = [f"{1e6 * slow * (a - t[0]):.6g},{1e6 * wide * b:.6g}" for a, b in zip(t, read, strict=True)]
    return "\n".join(["t_us,R_um", *rows]) + "\n"


def kinds(liquid: bool) -> tuple[str, ...]:
    """How the first bubble may be."""
    return tuple(kind for kind in KINDS if not liquid or kind not in ("law", "other"))


def campaign(seed: int, number: int, size: int, spread: float, liquid: bool, folder: Path) -> dict[str, float]:
    """Files of a campaign, and of its first bubble odd in each way; the medians of its gel."""
    rng = np.random.default_rng([20340, seed, number])
    gel = {
        name: value * float(np.exp(OF_GEL * rng.standard_normal()))
        for name, value in (LIQUID if liquid else GEL).items()
    }
    (p, p_std), (rho, rho_std), (c, c_std) = ATMOSPHERE, DENSITY, SOUND
    off = np.exp(np.array([p_std, rho_std, c_std, PIXEL]) * rng.standard_normal(4))
    constants = {"p_inf": f"{p * off[0]} kPa", "rho": f"{rho * off[1]} kg/m^3", "c": f"{c * off[2]} m/s"}
    for i in range(size):
        truth = {name: value * float(np.exp(spread * rng.standard_normal())) for name, value in gel.items()}
        truth["R_max"] = 4e-4 * float(np.exp(0.1 * rng.standard_normal()))
        truth["R_eq"] = truth["R_max"] / rng.uniform(*RATIO)
        noise = int(rng.integers(2**32))
        for kind in kinds(liquid) if i == 0 else KINDS[:1]:
            name = f"b{i:02d}" if kind == "clean" else f"odd_{kind}"
            text = film(truth, constants, kind, np.random.default_rng(noise))
            (folder / f"{name}.csv").write_text(scaled(text, off[3]))
    return gel


def scaled(text: str, factor: float) -> str:
    """Radii of a pixel that is off by a ``factor``."""
    head, *lines = text.splitlines()
    pairs = (line.split(",") for line in lines)
    return "\n".join([head, *(f"{t},{factor * float(r):.6g}" for t, r in pairs)]) + "\n"


def odd(seed: int, size: int, spread: float, liquid: bool, key: str) -> Record:
    """Who is named of the bubbles of one gel, the first of them as they are and odd in each way."""
    with TemporaryDirectory() as name, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        folder, config = Path(name) / "films", Path(name) / "gel.yaml"
        folder.mkdir()
        gel = campaign(seed, int(key), size, spread, liquid, folder)
        odd_ones = {file: file.read_text() for file in folder.glob("odd_*.csv")}
        for file in odd_ones:
            file.unlink()
        law = ["--law", "newtonian"] if liquid else []
        made = CliRunner().invoke(command_line, ["init", "--data", str(folder), "--out", str(config), *law])
        if made.exit_code:
            return {"failed": made.output.splitlines()[-1]}
        for file, text in odd_ones.items():
            file.write_text(text)
        population = load_config(config).population
        assert population is not None
        changes = {f"model.{part}": value for part, value in QUICK.items()} | {"execution.workers": 1}
        changes |= {"output.report": False, "output.directory": str(Path(name) / "run"), "population": None}
        changes |= {"assimilation.what_if": False}
        en4dvar.run_campaign(config, overrides=changes)
        return populations(Path(name) / "run", gel, spread, seed, population.part(HyperPrior))


def populations(run_dir: Path, gel: dict[str, float], spread: float, seed: int, hyper: HyperPrior) -> Record:
    """Of each kind: who is named, and whether the interval of the gel's medians holds the truth."""
    _, sets = finished([run_dir], True, None)
    problems, start = [s.problem for s in sets], [s.white for s in sets]
    drawn, left_out = sampled_sets(problems, start, seed, None, lambda words: None, [s.drawn for s in sets])
    of = {s.name: i for i, s in enumerate(sets)}
    names = list(gel)
    record: Record = {"left out": left_out, "medians": [np.log(value) for value in gel.values()]}
    terms = terms_of(problems, names)
    columns = [(term, problems[0].prior.names.index(name)) for name, term in zip(names, terms, strict=True)]
    rest = sorted(i for name, i in of.items() if name.startswith("b") and name != "b00")
    for kind in KINDS:
        first = of.get("b00" if kind == "clean" else f"odd_{kind}")
        if first is None or first not in drawn:
            continue
        some = {i: drawn[i] for i in (first, *(i for i in rest if i in drawn))}
        result = population_from(some, {}, start, problems, names, seed, hyper, Effort())
        median = result.posterior.median
        record[kind] = {
            "named": list(result.odd),
            "belongs": result.belongs,
            "ranks": [float(np.mean(median[:, j] < value)) for j, value in enumerate(gel.values())],
            "spread": [term.std * np.median(result.posterior.tau[:, j]) for j, term in enumerate(terms)],
            "spread ranks": [np.mean(term.std * result.posterior.tau[:, j] < spread) for j, term in enumerate(terms)],
            "own std": [[t.std * drawn[i].z[:, at].std() for t, at in columns] for i in some],
            "own mean": [[t.mean + t.std * drawn[i].z[:, at].mean() for t, at in columns] for i in some],
        }
    return record


def can_be_named(campaign: Record, spread: float) -> bool:
    """Whether a test to which the ``spread`` is known names the first one."""
    means, stds = np.array(campaign["own mean"]), np.array(campaign["own std"])
    z = (means[0] - means[1:].mean(axis=0)) / np.sqrt(stds[0] ** 2 + spread**2 * (1 + 1 / len(means[1:])))
    return bool(chi2.sf(z @ z, len(z)) < 1 - 0.95 ** (1 / len(means)))


def share(of: Sequence[bool]) -> str:
    return f"{100 * np.mean(of):.0f} %" if len(of) else "–"


def table(records: Sequence[Record], spread: float) -> None:
    print("| the first bubble | campaigns | named | can be named | others named | medians inside 90 % ", end="")
    print("| spreads inside 90 % | its own std of ln G, ln μ (of a liquid, ln μ) |")
    print("|---|---|---|---|---|---|---|---|")
    for kind in KINDS:
        of_it = [r[kind] for r in records if kind in r]
        others = [bool(set(r["named"]) - ({0} if kind != "clean" else set())) for r in of_it]
        inside = [
            share((np.abs(np.ravel([r[key] for r in of_it]) - 0.5) < 0.45).tolist())
            for key in ("ranks", "spread ranks")
        ]
        inside[1] = inside[1] if spread else "–"
        if not of_it:
            continue
        std = np.median([r["own std"][0] for r in of_it], axis=0)
        named = share([0 in r["named"] for r in of_it]) if kind != "clean" else "–"
        parts = [named, share([can_be_named(r, spread) for r in of_it]), share(others), *inside]
        print(f"| {kind} | {len(of_it)} | {' | '.join(parts)} | {', '.join(f'{s:.2f}' for s in std)} |")
    clean = [r for r in records if "clean" in r]
    off = np.array([np.median(r["clean"]["own mean"], axis=0) - r["medians"] for r in clean])
    for name, of_it in zip(list(GEL)[-len(off.T) :], off.T, strict=True):
        error = of_it.std() / np.sqrt(len(of_it))
        print(f"clean: medians of single means lie {of_it.mean():+.3f} ± {error:.3f} from the gel's, in ln {name}")
    for r in records:
        if "failed" in r:
            print(f"{r['key']}: {r['failed']}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--n", type=int, default=40)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--bubbles", type=int, default=12)
    parser.add_argument("--spread", type=float, default=0.2, help="of ln G and ln mu between the bubbles of a gel")
    parser.add_argument("--liquid", action="store_true")
    parser.add_argument("--minutes", type=float, default=9.0, help="start no campaign after so long")
    parser.add_argument("--records", type=Path, default=Path("runs/odd_bubbles"), help="folder of the records")
    o = parser.parse_args()
    file = o.records / f"{'liquid_' * o.liquid}{o.seed}_{o.bubbles}_{o.spread:g}.jsonl"
    records = fill(file, map(str, range(o.n)), partial(odd, o.seed, o.bubbles, o.spread, o.liquid), o.minutes)
    table(list(records.values()), o.spread)


if __name__ == "__main__":
    main()
