"""The measured bubbles of docs/polyacrylamide.md, from their files and from the movie itself (../shared/data).

python benchmarks/polyacrylamide.py gases     stiff gel: as stored, at the right scale, with heat and vapour
python benchmarks/polyacrylamide.py movie     stiff gel: G and μ of the movie read by machine and by hand
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from movies import SHARED

import en4dvar
from en4dvar.plumbing.files import write_text
from en4dvar_movie.frames import open_movie
from en4dvar_movie.table import Scale, to_csv
from en4dvar_movie.tracking import track

CONFIG = Path(__file__).resolve().parents[1] / "configs" / "polyacrylamide_estrada.yaml"
STORED = {
    "data.columns.radius.unit": "m",
    "parameters.R_eq": {"prior": "lognormal", "median": "63 um", "log_std": 0.02},
}
LASER = {"name": "bubble", "law": "neo-hookean-kelvin-voigt", "start": "laser"}
GASES = {
    "polytropic, as stored": STORED,
    "polytropic": {},
    "polytropic, quadratic law": {
        "model.law": "quadratic-kelvin-voigt",
        "parameters.alpha": {"prior": "lognormal", "median": 0.3, "log_std": 1.0},
    },
    "polytropic, no vapour": {"model.vapour_pressure": "0 Pa"},
    "heat, vapour frozen": {"model": {**LASER, "gas": "heat", "vapour": "frozen"}},
    "heat, vapour transported": {"model": {**LASER, "gas": "heat", "vapour": "transport"}},
}
PIXEL, RATE = 2.76e-6, 270e3
MISSED = {"data.error.discrepancy": "estimated"}
COLUMNS = {
    "data.columns.time": {"name": "t_us", "unit": "us"},
    "data.columns.radius": {"name": "R_um", "unit": "um"},
}
COLUMN = {"data.error.radius_std": {"column": "R_std_um", "unit": "um"}}
STATED = {**COLUMN, "data.error.model_std": "1 % of maximum"}
OWN = {**COLUMN, "data.error.time_std": {"column": "t_std_us", "unit": "us"}}


def estimates(name: str, folder: Path, overrides: Mapping[str, Any]) -> dict[str, tuple[float, float]]:
    """Posterior mean and std of G (kPa) and μ (Pa s), printed with NRMSE and χ²."""
    result = en4dvar.run(CONFIG, overrides={**overrides, "output.directory": str(folder / name)}, force=True)
    scores = result.sample_stats.attrs
    found = {}
    for parameter, unit in (("G", 1e3), ("mu", 1.0)):
        values = result.posterior[parameter].values.ravel() / unit
        found[parameter] = float(values.mean()), float(values.std(ddof=1))
    words = "  ".join(f"{key} {mean:.4g} ± {std:.2g}" for key, (mean, std) in found.items())
    chi = scores["chi2_per_observation"]
    print(f"{name:32s} {words}  NRMSE {scores['nrmse']:.3f}  χ²/n {chi:.2f}", flush=True)
    return found


def gases(folder: Path) -> None:
    file = {"data.path": str(SHARED / "PA1_exp2_RofTdata_0.mat")}
    for name, overrides in GASES.items():
        estimates(name, folder, {**file, **overrides})


def movie(folder: Path) -> None:
    """Radii of a person and of ``track`` under the same window, law and errors: how far apart in posterior std."""
    import scipy.io

    found = track(open_movie(SHARED / "PAstiff_xy002.mp4"), 2)
    by_hand = scipy.io.loadmat(SHARED / "PAstiff_xy002_RofT.mat")["Rnew"].ravel()
    person = [replace(r, radius=float(by_hand[r.frame])) for r in found.readings]
    scale = Scale(PIXEL, RATE)
    for name, readings in (("hand", person), ("track", found.readings)):
        write_text(folder / f"{name}.csv", to_csv(readings, scale, "PAstiff_xy002.mp4", name))
    for words, error in (
        ("1 %", {}),
        ("1 % and stated", STATED),
        ("1 %, discrepancy", MISSED),
        ("stated, discrepancy", {**MISSED, **OWN}),
    ):
        both = {
            name: estimates(f"{name}, {words}", folder, {"data.path": str(folder / f"{name}.csv"), **COLUMNS, **error})
            for name in ("hand", "track")
        }
        for key, (mean, std) in both["hand"].items():
            print(f"    {key}: {(both['track'][key][0] - mean) / std:+.2f} posterior std")


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as made:
        {"gases": gases, "movie": movie}[sys.argv[1] if len(sys.argv) > 1 else "gases"](Path(made))
