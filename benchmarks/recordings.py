"""Recordings as laboratories make them, through ``init`` and ``run`` with nothing changed by hand.

    python benchmarks/recordings.py                          24 synthetic recordings of seed 1, and a table
    python benchmarks/recordings.py --seed 7 --start 24 --n 24 --minutes 5    a piece; the next call goes on
    python benchmarks/recordings.py --movie --n 40           movies of bubbles, tracked
    python benchmarks/recordings.py --world wall-3 --with-what-if --n 50    readings the fit cannot make
    python benchmarks/recordings.py --set KEY=VALUE …        run with another value, any number of times
    python benchmarks/recordings.py --measured ../shared/data/bubbles/stiff_polyacrylamide
    python benchmarks/recordings.py --measured ../shared/data/bubbles/peg_water --law newtonian --medium water
    python benchmarks/recordings.py --since 'trough 3' --measured …    only what follows that of each recording
    python benchmarks/recordings.py --page bubbles.md --measured ../shared/data/bubbles/*    folders of known names

Synthetic: one bubble a recording, released in a gel of 0.1 to 100 kPa and 0.01 to 1 Pa s with the full gas model of
``init``; R_max 50 to 600 µm, 0.1 to 5 MHz, errors of 0.2 to 3 % of R_max, frames of the growth before it, gaps where
the bubble is small, sometimes a bad reading. Density, pressure and scale are those of a laboratory and not of the
program: drawn within what is known of them, and the file does not hold them. Printed are the share of 90 % and 50 %
intervals that hold the truth, the standard deviation of z in ln θ, which sets have no interval and why, and those that
are more than 3.5 standard deviations off, with a warning or without a word.

Movies: the same bubbles, 12 to 40 pixels large, rendered with noise, dirt and sometimes a bright centre, and tracked.

Measured: a folder of files with columns t_us, R_um of bubbles in one material; printed are the intervals, how many
readings after the window lie in their 90 % bands, and how far the bubbles agree, χ² of ln θ about their weighted mean
per degree of freedom.

Records are kept as JSON lines; ``--quick`` replaces the gas by an isothermal one in truth and fit, for exploring.
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import shlex
import subprocess
import sys
import time
import warnings
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import yaml
from click.testing import CliRunner
from measured_page import GROUPS, after, chi2, intervals, page, said, started, stated
from records import Record, fill
from scipy.signal import peak_widths
from scipy.special import ndtr
from wrong_worlds import WORLDS, Wrong

import en4dvar
from en4dvar.assembly.build import build
from en4dvar.cli import main as command_line
from en4dvar.config import load_config
from en4dvar.data.extrema import minima
from en4dvar.diagnosis.diagnostics import member_quantiles
from en4dvar.diagnosis.withheld import BAND, expectations, quantile
from en4dvar.executor import SerialExecutor
from en4dvar.model.state import Array
from en4dvar.problem import InverseProblem
from en4dvar.report.result import Result
from en4dvar.report.text import shown
from en4dvar_bubble.model import BubbleModel
from en4dvar_movie.filming import Camera, exposures
from en4dvar_movie.frames import write_movie
from en4dvar_movie.scene import Scene, render

LAWS = {"neo-hookean-kelvin-voigt": 0.5, "quadratic-kelvin-voigt": 0.3, "newtonian": 0.2}  # and how often
FULL = {"gas": "heat", "vapour": "transport", "medium_heat": "conducting"}
QUICK = {"gas": "isothermal", "vapour": "none", "medium_heat": "cold", "vapour_pressure": "saturated"}
FRAMES = (6.0, 80.0)  # of a collapse, between which a camera is set
CELLS = 40_000  # instants of the model's path that readings are interpolated from
INSIDE = {90: (0.05, 0.95), 50: (0.25, 0.75)}
FAR = 3.5
PROMINENT = 0.03  # of the range of readings: a minimum after the window
NUMBERS = ("G", "mu")


def between(stream: np.random.Generator, low: float, high: float) -> float:
    """A number whose logarithm is uniform."""
    return float(np.exp(stream.uniform(np.log(low), np.log(high))))


def laboratory(
    stream: np.random.Generator, physics: dict[str, str], world: Wrong | None
) -> tuple[Wrong, dict[str, float], BubbleModel]:
    """The world (without one: what is fitted is right), true values, and the model of one experiment."""
    drawn = str(stream.choice(list(LAWS), p=list(LAWS.values())))
    world = world or Wrong(drawn)
    law = world.fitted
    truth = {"mu": between(stream, 0.01, 1.0), "R_max": between(stream, 50e-6, 600e-6)}
    truth["R_eq"] = truth["R_max"] * float(np.exp(np.log(0.13) + 0.3 * stream.standard_normal()))
    gel = law != "newtonian"
    if gel:
        truth["G"] = between(stream, 100.0, 1e5)
    if law.startswith("quadratic"):
        truth["alpha"] = between(stream, 0.02, 1.0)
    density = stream.uniform(1000.0, 1060.0) if gel else stream.uniform(995.0, 1035.0)
    constants = {"rho": f"{density} kg/m^3", "p_inf": f"{101.325 * (1 + 0.01 * stream.standard_normal())} kPa"}
    return world, truth, world.model(truth, physics, constants)


@dataclass(frozen=True)
class Bubble:
    """One that is filmed: its ``radius`` (m) at ``times`` (s) from R_max on, by a camera of that ``rate`` (1/s), which
    is ``faster`` than the file says; ``t_c`` (s), a collapse without elasticity; ``stream`` draws what is left.
    """

    law: str
    truth: dict[str, float]
    times: Array
    radius: Array
    rate: float
    faster: float
    t_c: float
    stream: np.random.Generator

    def instants(self) -> Array:
        """Of its frames, from the growth on."""
        stream, t_c, rate = self.stream, self.t_c, self.rate
        grown = stream.uniform(0.2, 0.9) if stream.random() < 0.7 else 0.0  # of the collapse time, seen before R_max
        last = min(stream.uniform(3.0, 7.5) * t_c, 256 / rate)
        return np.asarray(np.arange(-np.floor(grown * t_c * rate) + stream.random(), last * rate) / rate)

    def model_time(self, t: Array, skew: float) -> Array:
        """Growth is no mirror image of the collapse, which has the same R and R̈ at the top."""
        return np.where(t < 0, -t * (1 - skew * t / self.t_c), t)


def bubble(seed: int, physics: dict[str, str], world: Wrong | None = None) -> Bubble:
    """One that can be filmed with so many frames of a collapse as :data:`FRAMES`."""
    stream = np.random.default_rng([33, seed])
    while True:
        made, truth, model = laboratory(stream, physics, world)
        medium = model.medium
        t_c = 0.9147 * truth["R_max"] * np.sqrt(medium.rho / medium.p_inf)
        rate = between(stream, 0.1e6, 5e6)
        if not FRAMES[0] < rate * t_c < FRAMES[1]:
            continue
        times = np.linspace(0.0, 8 * t_c, CELLS)
        radius = made.radius(model, truth, times)
        if radius is not None:
            values = made.as_fitted(truth, times, radius)
            return Bubble(made.fitted, values, times, radius, rate, made.rate, t_c, stream)


def recording(seed: int, physics: dict[str, str], world: Wrong | None = None) -> tuple[str, dict[str, float], str]:
    """Law, true values, and the text of a file of radii."""
    filmed = bubble(seed, physics, world)
    stream, times, radius = filmed.stream, filmed.times, filmed.radius
    noise = between(stream, 0.002, 0.03) * radius[0]
    t = filmed.instants()
    fast = filmed.model_time(t, stream.uniform(-0.1, 0.3))
    at = fast + 0.02 / filmed.rate * stream.standard_normal(len(t))
    read = np.interp(np.abs(at), times, radius) + noise * stream.standard_normal(len(t))
    small = np.interp(fast, times, radius) < 0.06 * radius[0]
    gap = (stream.random(len(t)) < 0.01) | (small & (stream.random(len(t)) < 0.5))
    if stream.random() < 0.2:
        read[stream.integers(len(t))] += stream.choice([-1, 1]) * stream.uniform(6, 15) * noise
    scale = 1 + 0.005 * stream.standard_normal()
    kept = ~gap & (read > 0.005 * radius[0])
    fast = filmed.faster * 1e6 * (t[kept] - t[0])
    rows = [f"{a:.6g},{1e6 * scale * b:.6g}" for a, b in zip(fast, read[kept], strict=True)]
    return filmed.law, filmed.truth, "\n".join(["t_us,R_um", *rows]) + "\n"


def movie(seed: int, physics: dict[str, str], world: Wrong | None = None) -> tuple[str, dict[str, float], str]:
    """Law, true values, and the table that ``track`` reads from a movie, whose scale is off as that of a recording."""
    filmed = bubble(seed, physics, world)
    stream, across = filmed.stream, between(filmed.stream, 12.0, 40.0)  # pixels of R_max
    t, skew = filmed.instants(), filmed.stream.uniform(-0.1, 0.3)
    camera = Camera(filmed.radius[0] / across, exposure := between(stream, 0.02, 0.2) / filmed.rate, 0.1 * exposure)
    exposed = exposures(t + camera.jitter * stream.standard_normal(len(t)), camera)
    at = np.abs(filmed.model_time(exposed, skew))
    radii = np.interp(at, filmed.times, filmed.radius).reshape(len(t), -1) / camera.pixel
    side = max(48, round(2.8 * across))
    noise, middle = 75 / between(stream, 5.0, 25.0), 0.5 * side + stream.uniform(-1.0, 1.0, 2)
    scene = Scene((side, side), noise=noise, dirt=8, centre=float(stream.choice([0.0, 0.4])), drift=0.02,
                  bubble=tuple(middle))  # fmt: skip
    with TemporaryDirectory() as name:
        tif, table = Path(name) / "bubble.tif", Path(name) / "bubble.csv"
        pixel = camera.pixel * (1 + 0.005 * stream.standard_normal())
        write_movie(tif, render(radii, scene, stream), scene.before + len(t), pixel, filmed.rate / filmed.faster)
        asked = ["track", str(tif), "--exposure", f"{1e9 * exposure} ns", "--out", str(table), "--workers", "1"]
        made = CliRunner().invoke(command_line, asked)
        return filmed.law, filmed.truth, table.read_text() if table.is_file() else f"# {made.output}"


def verbatim(
    text: str,
    law: str,
    words: list[str],
    quick: bool,
    with_what_if: bool = False,
    change: Callable[[dict[str, Any]], None] | None = None,
    with_chances: bool = False,
    values: Sequence[str] = (),
) -> Record:
    """What ``init`` and ``run`` say of a file, from a folder of its own, beside what its head states; with ``change``
    of the configuration between them or ``values`` of it as KEY=VALUE, and ``with_chances`` how many readings after the
    window should be in their bands.
    """
    begun = time.process_time()
    with TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "bubble.csv").write_text(text)
        config = folder / "bubble.yaml"
        asked = ["--data", str(folder / "bubble.csv"), "--law", law, "--out", str(config), *words, *started(text)]
        made = CliRunner().invoke(command_line, ["init", *asked])
        if made.exit_code or not config.is_file():
            return {"reason": f"init: {made.output.strip().splitlines()[-1] if made.output else made.exception}"}
        if change:
            settings = yaml.safe_load(config.read_text())
            change(settings)
            config.write_text(yaml.safe_dump(settings, sort_keys=False))
        changes: dict[str, Any] = {"execution.workers": 1, "output.report": False}
        changes |= {"output.directory": str(folder / "run")}
        changes |= {f"model.{key}": value for key, value in QUICK.items()} if quick else {}
        changes |= {"assimilation.what_if": "added"} if with_what_if else {}
        changes |= {**stated(text), **dict(value.split("=", 1) for value in values)}
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                result = en4dvar.run(config, overrides=changes)
        except Exception as error:
            return {"reason": f"run: {str(error).splitlines()[0] if str(error) else type(error).__name__}"}
        with (folder / "run" / "summary.csv").open() as file:
            rows = {row["name"]: row for row in csv.DictReader(file)}
        found: Record = {"seconds": time.process_time() - begun, "warnings": next(iter(rows.values()))["warnings"]}
        for key in (*NUMBERS, "alpha", "R_eq", "R_max", "t_s", "wall_distance", "damage", "accommodation", "mu_p"):
            if key in rows:
                found[key] = _posterior(result.posterior[key].values.ravel(), rows[key])
        found["withheld"] = _withheld(result.sample_stats.attrs, found.get("R_max", {"mean": np.nan})["mean"])
        found["next"] = _next(result, found.get("R_max", {"mean": np.nan})["mean"])
        if with_chances and found["withheld"]:
            parts = {"next": (found["next"] or [0])[0], "withheld": found["withheld"][0]}
            found["chances"] = chances(build(load_config(config, changes))[0], result, parts)
        found["log_evidence"] = float(result.sample_stats.attrs.get("log_evidence", np.nan))
        return found


def _withheld(stats: Any, largest: float) -> tuple[int, float, float] | None:
    """How many readings follow the window, their share in the 90 % bands, and their rms in units of R_max."""
    if "withheld_readings" not in stats:
        return None
    return int(stats["withheld_readings"]), float(stats["withheld_inside"]), float(stats["withheld_rms"]) / largest


def _next(result: Result, largest: float) -> tuple[int, float, float] | None:
    """How many readings follow the window to the next minimum, their share in the 90 % bands, and rms over R_max."""
    if "/withheld" not in result.groups:
        return None
    held, within = result.group("withheld"), shown(result.group("observed_data")["radius"])
    readings, low, median, high = (shown(held[f"radius{part}"]) for part in ("", "_low", "_median", "_high"))
    count = to_the_next_minimum(within, readings)
    if not count:
        return None
    share = float(np.mean(((low <= readings) & (readings <= high))[:count]))
    return count, share, float(np.sqrt(np.mean((readings - median)[:count] ** 2))) * 1e-6 / largest  # they are in µm


def chances(problem: InverseProblem, result: Result, parts: dict[str, int]) -> dict[str, list[float]]:
    """Of each part, so many readings after the window: the chance that 0, 1, 2, … of them lie in their 90 % bands, were
    they what the estimate expects. Given a member they lie there independently, but all of them are of one member; what
    the discrepancy makes them share besides is left out, so that the true spread is wider.
    """
    members = np.column_stack([result.posterior[name].values.ravel() for name in problem.prior.names])
    expected = expectations(problem, problem.prior.from_physical(members), SerialExecutor())
    assert expected is not None  # the run has bands
    (mean, std), (low, high) = expected, (quantile(*expected, level) for level in BAND)
    inside = ndtr((high - mean) / std) - ndtr((low - mean) / std)
    found = {}
    for part, count in parts.items():
        of = np.ones((len(inside), 1))
        for share in inside[:, :count].T:
            of = np.pad(of * (1 - share[:, None]), ((0, 0), (0, 1))) + np.pad(of * share[:, None], ((0, 0), (1, 0)))
        found[part] = [float(f"{chance:.3g}") for chance in of.mean(axis=0)]
    return found


def to_the_next_minimum(within: Array, later: Array) -> int:
    """How many of the readings after the window there are up to the next minimum; 0 without one."""
    series = np.concatenate([within, later])
    ends = minima(series, PROMINENT)
    begins = peak_widths(-series, ends, rel_height=0.5)[2]  # the window ends in the middle of one
    return next((int(e) + 1 - len(within) for e, b in zip(ends, begins, strict=True) if b > len(within)), 0)


def _posterior(members: Any, row: dict[str, str]) -> Record:
    members = members[np.isfinite(members)]
    logs = np.log(np.maximum(members, 1e-300))
    levels = (0.05, 0.25, 0.5, 0.75, 0.95)
    said = {str(p): float(q) for p, q in zip(levels, member_quantiles(members, levels), strict=True)}
    moments = {"mean": float(members.mean()), "std": float(members.std(ddof=1))}
    return {**said, **moments, "ln": (float(logs.mean()), float(logs.std(ddof=1))), "untrusted": row["untrusted"]}


def synthetic(seed: int, o: argparse.Namespace) -> Record:
    make = movie if o.movie else recording
    law, truth, text = make(seed, QUICK if o.quick else FULL, WORLDS.get(o.world))
    return {"law": law, "truth": truth, **verbatim(text, law, [], o.quick, o.with_what_if, values=o.set)}


def table(records: list[Record]) -> None:
    """Coverage, z, and what has no interval."""
    seconds = [r["seconds"] for r in records if "seconds" in r]
    print(f"{len(records)} recordings; processor seconds of a set: median {np.median(seconds or [np.nan]):.1f}")
    print(
        "| | sets | with interval | 90 % hold | 50 % hold "
        "| truth below, above | std of z | mean of z | beyond 3.5 std |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    for key in NUMBERS:
        sets = [r for r in records if key in r["truth"]]
        told = [r for r in sets if key in r and not r[key]["untrusted"]]
        z = np.array([z_of(r, key) for r in told])
        held = [
            sum(r[key][str(low)] <= r["truth"][key] <= r[key][str(high)] for r in told) / max(1, len(told))
            for low, high in INSIDE.values()
        ]
        beside = [
            sum(r["truth"][key] < r[key]["0.05"] for r in told), sum(r["truth"][key] > r[key]["0.95"] for r in told)
        ]  # fmt: skip
        off = [r["key"] + " (warned)" * bool(r["warnings"]) for r in told if abs(z_of(r, key)) > FAR]
        shares = " | ".join([*(f"{share:.0%}" for share in held), f"{beside[0]}, {beside[1]}"])
        moments = f"{z.std():.2f} | {z.mean():+.2f}" if len(z) else "– | –"
        print(f"| {key} | {len(sets)} | {len(told)} | {shares} | {moments} | {', '.join(off) or 'none'} |")
    reasons = Counter(why(r) for r in records)
    for reason, count in reasons.most_common():
        if reason:
            print(f"no interval, {count}: {reason} ({', '.join(r['key'] for r in records if why(r) == reason)})")


def z_of(record: Record, key: str) -> float:
    mean, std = record[key]["ln"]
    return float((np.log(record["truth"][key]) - mean) / std)


def why(record: Record) -> str:
    """Why a set has no interval of the viscosity, "" where it has one."""
    return str(record["reason"] if "reason" in record else record["mu"]["untrusted"])


def agreement(records: list[Record]) -> None:
    """Intervals of measured bubbles, readings after their windows, and χ² of ln θ about their weighted mean."""
    for r in records:
        told = "; ".join(f"{k} {said(r[k], 1e-3 if k == 'G' else 1.0)}" for k in NUMBERS if k in r)
        count, share, rms = r.get("withheld") or (0, 0.0, 0.0)
        later = f"; after the window {share:.0%} of {count}, {100 * rms:.1f} % of R_max" if count else ""
        print(f"{r['key']}: {told or r['reason']}{later} [{r.get('warnings', '')}] {r.get('seconds', 0):.0f} s")
    for key in NUMBERS:
        logs = intervals(records, key)
        if len(logs) > 1:
            print(
                f"{key}: {len(logs)} of {len(records)} intervals; χ² of ln {key} per degree of freedom {chi2(logs):.2f}"
            )
    for key, words in (("withheld", "after the windows"), ("next", "from there to the next minimum")):
        count, inside = after(records, key)
        print(f"readings {words}: {count}, {inside:.0%} in their 90 % bands")


def measured(folder: Path, law: str, medium: str, o: argparse.Namespace) -> list[Record]:
    """The records of a folder's bubbles."""
    words = ["--medium", medium] * bool(medium) + ["--since", o.since] * bool(o.since)
    asked = f"{folder.name} {law} {words} {shlex.join(o.set)}".rstrip()
    mark = hashlib.sha256(asked.encode()).hexdigest()[:6]
    files = {file.stem: file for file in sorted(folder.glob("*.csv"))}
    path = o.records / f"{folder.name}_{mark}.jsonl"
    at = commit()

    def run(key: str) -> Record:
        return {"commit": at, **verbatim(files[key].read_text(), law, words, o.quick, with_chances=True, values=o.set)}

    done = fill(path, files, run, o.minutes)
    return list(done.values())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=1, help="of the design; each recording has a seed of its own")
    parser.add_argument("--start", type=int, default=0)
    parser.add_argument("--n", type=int, default=24)
    parser.add_argument("--minutes", type=float, default=np.inf, help="start no set after so long")
    parser.add_argument("--quick", action="store_true", help="isothermal gas in truth and fit")
    parser.add_argument("--world", default="", choices=["", *WORLDS], help="what the fit does not know of")
    parser.add_argument("--movie", action="store_true", help="render a movie of each bubble, and track it")
    parser.add_argument("--with-what-if", action="store_true", help="as of run")
    parser.add_argument("--measured", type=Path, nargs="*", default=[], help="folders of measured bubbles instead")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="of run")
    parser.add_argument("--since", default="", metavar="INSTANT", help="of init: what is before is left out")
    parser.add_argument("--law", default="neo-hookean-kelvin-voigt", help="of the measured material")
    parser.add_argument("--medium", default="", help="of the measured material, as init takes it")
    parser.add_argument(
        "--page", type=Path, help="write a page about folders of known names, with their law and medium"
    )
    parser.add_argument("--records", type=Path, default=Path("runs/recordings"), help="folder of the records")
    o = parser.parse_args()
    if not o.measured:
        keys = [str(1000 * o.seed + i) for i in range(o.start, o.start + o.n)]
        set_ = hashlib.sha256(shlex.join(o.set).encode()).hexdigest()[:6] if o.set else ""
        marks = [o.world, "movie" * o.movie, "what_if" * o.with_what_if, set_]
        kind = "_".join(["quick" if o.quick else "full", *filter(None, marks)])
        table(list(fill(o.records / f"{kind}.jsonl", keys, lambda key: synthetic(int(key), o), o.minutes).values()))
    groups = {}
    for folder in o.measured:
        group = GROUPS.get(folder.name)
        law, medium = (group.law, group.medium) if group and o.page else (o.law, o.medium)
        print(f"{folder.name}, {law} {medium}")
        groups[folder.name] = measured(folder, law, medium, o)
        agreement(groups[folder.name])
    if o.page:
        o.page.write_text(page(groups, f"python {shlex.join(sys.argv)}"), encoding="utf-8")


def commit() -> str:
    """The commit of this file's clone."""
    words = ["git", "-C", str(Path(__file__).parent), "rev-parse", "--short", "HEAD"]
    return subprocess.run(words, capture_output=True, text=True, check=False).stdout.strip() or "unknown"


if __name__ == "__main__":
    main()
