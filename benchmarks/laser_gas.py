"""Which gas should ``en4dvar init`` propose for a laser-induced bubble?

    python benchmarks/laser_gas.py twins               10 sets of two designs, made by the fullest physics, by each gas
    python benchmarks/laser_gas.py twins --minutes 4   a piece of it: records are kept and the next call goes on
    python benchmarks/laser_gas.py measured            the measured bubbles (../shared/data) as ``init`` proposes them

The designs are those of benchmarks/laser_twin.py, each of 30 readings: *soft*, 1.4 µs apart with informed priors, and
*stiff*, 3.7 µs apart with the priors of ``init``. Reported for the twins: how many of 200 members drawn from the prior
fail, and how long a run takes; of the fits the processor time, in how many the interval between members that holds 45
of the 49 ranks (91.8 %) covers the truth, the median distance of the mean from it in posterior standard deviations, and
as a factor, how many warn (graver than a note), and by how much the log-evidence is below that of the fullest physics.
The number of a set is its seed. A measured bubble is estimated with the radius at rest of its file, where there is one,
and with a prior of ± 30 % about what is seen.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from laser_twin import make_laser_twin, stiff_gel
from movies import SHARED
from records import Record, fill
from worlds import CENTRAL, Twin, World, experiment

import en4dvar
from en4dvar.ensemble.forecast import forecast
from en4dvar.schemes.settings import AssimilationSettings
from en4dvar_bubble import BubbleModel
from en4dvar_bubble.settings import BubbleSettings
from en4dvar_bubble.starter import propose_config

RELEASED = {"law": "neo-hookean-kelvin-voigt", "start": "laser"}
GASES: Mapping[str, Mapping[str, str]] = {
    "polytropic, saturated vapour": {"gas": "polytropic", "vapour_pressure": "saturated"},
    "heat, saturated vapour": {"gas": "heat", "vapour_pressure": "saturated"},
    "heat, vapour transport": {"gas": "heat", "vapour": "transport"},
    "heat, vapour transport, conducting medium": {"gas": "heat", "vapour": "transport", "medium_heat": "conducting"},
}
MODELS = {
    gas: BubbleModel.from_settings(BubbleSettings.model_validate({**RELEASED, **keys})) for gas, keys in GASES.items()
}
FULLEST = list(GASES)[-1]
DESIGNS = {"soft": make_laser_twin, "stiff": stiff_gel}
FIRST, MEMBERS, DRAWN = 600, 48, 200
UNITS = {"G": ("kPa", 1e3), "mu": ("Pa s", 1.0), "R_eq": ("µm", 1e-6)}
FILES = {
    "stiff gel": ("PA1_exp2_RofTdata_0.mat", "Rnew", "0.7452*m", {}),
    "soft gel, R_eq of the file": ("A_E2_002.mat", "R", "um", {}),
    "soft gel": (
        *("A_E2_002.mat", "R", "um"),
        {"parameters.R_eq": {"prior": "lognormal", "median": "22 um", "log_std": 0.3}},
    ),
}


def fitted(key: str) -> Record:
    """One set of a design by one gas, and members drawn from its prior."""
    design, gas, seed = key.split("/")
    twin: Twin = DESIGNS[design](int(seed), MODELS[gas], World(MODELS[FULLEST]))
    of = twin.problem.prior
    drawn = of.mean + of.std * np.random.default_rng([20214, int(seed)]).standard_normal((DRAWN, len(of.names)))
    begin = time.process_time()
    failures = forecast(twin.problem, drawn).failures
    between = time.process_time()
    record = experiment(int(seed), twin, AssimilationSettings(what_if=False))
    timed = {"run_ms": 1e3 * (between - begin) / DRAWN, "seconds": time.process_time() - between}
    return {**record, **timed, "drawn_failed": sum(bool(f) for f in failures), "names": of.names}


def table_of_twins(found: Mapping[str, Record], seeds: Sequence[int]) -> None:
    """A line a design and gas."""
    heads = ["design, gas", "sets", "a run, ms", "prior members that fail", "a fit, s"]
    heads += [f"{name} {what}" for name in UNITS for what in ("covered", "off by (std)", "by a factor")]
    heads += ["warn", "of what", "log-evidence below the fullest"]
    print(f"| {' | '.join(heads)} |\n{'|---' * len(heads)}|")
    for design in DESIGNS:
        full = {s: found.get(f"{design}/{FULLEST}/{s}", {}).get("log_evidence", np.nan) for s in seeds}
        for gas in GASES:
            records = {s: found[key] for s in seeds if (key := f"{design}/{gas}/{s}") in found}
            good = {s: r for s, r in records.items() if "rank" in r}
            if good:
                below = [full[s] - r["log_evidence"] for s, r in good.items()]
                cells = [f"{design}, {gas}", f"{len(good)} of {len(records)}", *line(list(good.values()))]
                print(f"| {' | '.join(cells)} | {np.median(below):.1f} ({min(below):.1f} to {max(below):.1f}) |")


def line(good: Sequence[Record]) -> list[str]:
    """Time, failures, coverage and warnings of a line of the table."""
    cells = [f"{np.median([r['run_ms'] for r in good]):.2f}", f"{np.mean([r['drawn_failed'] for r in good]):.1f}"]
    cells += [f"{np.median([r['seconds'] for r in good]):.1f}"]
    for name in UNITS:
        j = good[0]["names"].index(name)
        inside = [2 * abs(r["rank"][j] - MEMBERS / 2) < CENTRAL[1] for r in good]
        off = np.array([abs(r["mean"][j] - r["truth"][j]) for r in good])
        std = np.array([r["std"][j] for r in good])
        cells += [f"{sum(inside)}", f"{np.median(off / std):.1f}", f"{np.exp(np.median(off)):.2f}"]
    codes = Counter(code for r in good for code in set(r["graver"]))
    told = ", ".join(f"{code} {count}" for code, count in codes.most_common(3))
    return [*cells, f"{sum(bool(r['graver']) for r in good)}", told]


def measured(folder: Path) -> None:
    """Each measured bubble as ``init`` proposes it, with the gas exchanged."""
    heads = ["bubble, gas", *(f"{name} ({unit})" for name, (unit, _) in UNITS.items())]
    heads += ["NRMSE", "χ² per reading", "log-evidence", "runs", "s", "warns of"]
    print(f"| {' | '.join(heads)} |\n{'|---' * len(heads)}|")
    for name, (file, column, unit, changes) in FILES.items():
        proposed = propose_config(SHARED / file, radius=(column, unit), time=("t", "s"), folder=folder)
        config = folder / f"{name}.yaml"
        config.write_text(proposed.text, encoding="utf-8")
        for gas, keys in GASES.items():
            model = {"name": "bubble", **RELEASED, **keys}
            out = {"model": model, "output.directory": str(folder / f"{name}, {gas}"), **changes}
            begin = time.process_time()
            result = en4dvar.run(config, overrides=out, force=True)
            cells = _estimates(result, time.process_time() - begin)
            print(f"| {name}, {gas} | {' | '.join(cells)} |", flush=True)


def _estimates(result: Any, seconds: float) -> list[str]:
    cells, scores = [], result.sample_stats.attrs
    for name, (_, scale) in UNITS.items():
        fixed = name not in result.posterior
        values = np.zeros(1) if fixed else result.posterior[name].values.ravel() / scale
        cells.append("–" if fixed else f"{values.mean():.3g} ± {values.std(ddof=1):.2g}")
    cells += [f"{scores['nrmse']:.3f}", f"{scores['chi2_per_observation']:.2f}", f"{scores['log_evidence']:.1f}"]
    codes = ", ".join(c.code for c in result.cautions if c.severity != "note")
    return [*cells, f"{scores['forward_runs']}", f"{seconds:.1f}", codes]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("twins", "measured"))
    parser.add_argument("--n", type=int, default=10, help="sets of each design")
    parser.add_argument("--minutes", type=float, default=np.inf, help="start no fit after so long")
    parser.add_argument("--records", type=Path, default=Path("runs/laser_gas"), help="folder of the records")
    options = parser.parse_args()
    if options.what == "measured":
        with tempfile.TemporaryDirectory() as made:
            measured(Path(made))
        return
    seeds = range(FIRST, FIRST + options.n)
    keys = [f"{design}/{gas}/{seed}" for seed in seeds for design in DESIGNS for gas in GASES]
    table_of_twins(fill(options.records / "twins.jsonl", keys, fitted, options.minutes), seeds)


if __name__ == "__main__":
    main()
