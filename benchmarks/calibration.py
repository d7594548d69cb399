"""Is the posterior calibrated? ``en4dvar calibrate`` on configurations of bubbles: truths drawn from the prior.

    python benchmarks/calibration.py a                 30 % priors (configs/quickstart.yaml), En4D-Var alone
    python benchmarks/calibration.py b                 the same with wide priors, ``refine: mcmc``
    python benchmarks/calibration.py rebound           wide priors, 30 readings through collapse and rebound
    python benchmarks/calibration.py laser             laser-induced bubbles with rebounds, default settings
    python benchmarks/calibration.py stiff             a stiff gel, polytropic gas, wide priors
    python benchmarks/calibration.py proposed          the same, gas of ``init``: heat, vapour, conducting medium

Its table: of every parameter whether the ranks of the truths are uniform, mean and standard deviation of z, and how
many of the 50 and 90 % intervals hold the truth. An interrupted command goes on when it is called again, also with more
``--sets``. The designs of ``laser``, ``stiff`` and ``proposed`` are those of benchmarks/laser_twin.py.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import acoustic_twin
import laser_twin
import numpy as np

from en4dvar import calibrate
from en4dvar.model.state import Array
from en4dvar_bubble.starter.physics import MODEL, SIMPLER

Settings = dict[str, Any]
QUICKSTART = Path(__file__).parents[1] / "configs" / "quickstart.yaml"
WIDE = {f"parameters.{name}.log_std": std for name, std in acoustic_twin.WIDE.items()}
COLUMNS = {"time": {"name": "t_us", "unit": "us"}, "radius": {"name": "R_um", "unit": "um"}}
TIMES: dict[str, Array] = {
    "rebound": np.linspace(4e-6, 60e-6, 30),
    "laser": laser_twin.TIMES,
    "stiff": laser_twin.STIFF_TIMES,
    "proposed": laser_twin.STIFF_TIMES,
}


def lognormal(name: str, median: float, log_std: float) -> Settings:
    return {"prior": "lognormal", "median": f"{median} {laser_twin.PARAMETERS[name].unit}", "log_std": log_std}


def normal(mean: str, std: str) -> Settings:
    return {"prior": "normal", "mean": mean, "std": std}


def released(error: str, parameters: Settings, **physics: str) -> Settings:
    """A laser-induced bubble in a neo-Hookean gel; its readings have these errors."""
    return {
        "name": "released",
        "data": {"columns": COLUMNS, "error": {"radius_std": error}},
        "model": {"name": "bubble", "law": "neo-hookean-kelvin-voigt", "start": "laser", **physics},
        "parameters": parameters,
    }


SOFT_GEL = {
    **{name: lognormal(name, median, laser_twin.LOG_STD[name]) for name, median in laser_twin.MEDIANS.items()},
    "R_max": normal("250 um", "5 um"),
}
STIFF_GEL = {
    **{name: lognormal(name, *about) for name, about in laser_twin.STIFF.items()},
    "R_max": normal("400 um", "4 um"),
    "t_s": normal("0 us", "0.5 us"),
}
CASES: dict[str, tuple[Settings | Path, Settings]] = {
    "a": (QUICKSTART, {"assimilation.refine": "none"}),
    "b": (QUICKSTART, {"assimilation.refine": "mcmc", **WIDE}),
    "rebound": (QUICKSTART, WIDE),
    "laser": (released("1.5 um", SOFT_GEL, gas="polytropic"), {}),
    "stiff": (released("4 um", STIFF_GEL, **SIMPLER["laser"]), {}),
    "proposed": (released("4 um", STIFF_GEL, **MODEL["laser"]), {}),
}


def times_of(case: str, folder: Path) -> Settings:
    """A file of the instants of readings, whose radii play no part."""
    if case not in TIMES:
        return {}
    path = folder / f"{case}.csv"
    lines = "".join(f"{1e6 * t:.6g},100\n" for t in TIMES[case])
    path.write_text(f"t_us,R_um\n{lines}", encoding="utf-8")
    return {"data.path": str(path.resolve())}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("case", choices=tuple(CASES))
    parser.add_argument("--seed", type=int, default=1, help="of the truths and their readings")
    parser.add_argument("--sets", type=int, default=400)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--records", type=Path, default=Path("runs/calibration"), help="folder of the records")
    o = parser.parse_args()
    o.records.mkdir(parents=True, exist_ok=True)
    config, changed = CASES[o.case]
    overrides = {**changed, **times_of(o.case, o.records), "seed": o.seed, "execution.workers": o.workers}
    out = o.records / f"{o.case}_{o.seed}"
    result = calibrate(config, o.sets, overrides=overrides, out=out, resume=out.exists())
    print(f"case {o.case}, seed {o.seed}\n{result}")
    print("\n".join(f"note: {remark}" for remark in result.remarks))


if __name__ == "__main__":
    main()
