"""From the movie to the gel: do 90 % intervals of G and μ cover the truth that a rendered movie was made with?

    python benchmarks/movie_to_gel.py --n 100               truths from the prior, movie → track → estimate
    python benchmarks/movie_to_gel.py --n 100 --minutes 4   a piece of it: records are kept and the next call goes on

Each experiment goes through files as a user's does: ``film`` writes a TIFF, ``track`` its table, whose columns are the
errors of the estimate; nothing is told that the movie does not show. Frames of 96 × 96 pixels of 6 µm, an exposure of
200 ns whose instant is off by a tenth of it and an edge whose level is off in all frames alike, as the table supposes,
contrast over noise 5 to 25, half of the bubbles with a bright centre, uneven light, dirt.
"""

from __future__ import annotations

import argparse
import tempfile
from collections import Counter
from pathlib import Path

import numpy as np
from records import Record, fill
from worlds import table

from en4dvar.assembly.build import build
from en4dvar.config import load_config
from en4dvar.estimation.assimilate import assimilate
from en4dvar.plumbing.errors import En4dvarError
from en4dvar.plumbing.files import write_text
from en4dvar.schemes.settings import AssimilationSettings
from en4dvar_movie.filming import film
from en4dvar_movie.frames import open_movie
from en4dvar_movie.table import Scale, to_csv
from en4dvar_movie.tracking import track

STEP, EXPOSURE, FIRST, COUNT = 1.4e-6, 200e-9, 0.7e-6, 30
CONFIG = """
name: movie_to_gel
data:
  path: bubble.csv
  columns: {time: {name: t_us, unit: us}, radius: {name: R_um, unit: um}}
  time_zero: 3.5 us  # three empty frames, the fourth 0.7 us after the largest radius
  error: {radius_std: {column: R_std_um, unit: um}, time_std: {column: t_std_us, unit: us}}
model: {name: bubble, law: neo-hookean-kelvin-voigt, start: laser, gas: polytropic}
parameters:
  G: {prior: lognormal, median: 4 kPa, log_std: 0.5}
  mu: {prior: lognormal, median: 0.06 Pa s, log_std: 0.5}
  R_eq: {prior: lognormal, median: 35 um, log_std: 0.2}
  R_max: {prior: normal, mean: 250 um, std: 5 um}
  reading_offset: {prior: normal, mean: 0 um, std: 0.9 um}  # R_common_um of the tables
"""


def scenery(rng: np.random.Generator) -> dict[str, str]:
    """Settings of a movie."""
    ratio = np.exp(rng.uniform(np.log(5), np.log(25)))
    x, y = 47.5 + rng.uniform(-0.5, 0.5, 2)
    return {
        "pixel": "6 um", "exposure": "200 ns", "jitter": "20 ns", "shape": "96x96", "noise": f"{75 / ratio:.3f}",
        "dirt": "8", "centre": f"{rng.choice([0.0, 0.4]):g}", "drift": "0.05", "bubble": f"{x:.3f},{y:.3f}",
    }  # fmt: skip


def experiment(key: str) -> Record:
    """Ranks and moments (n,) of the posterior, the truth, and how many frames were read."""
    rng = np.random.default_rng([20260, int(key)])
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        write_text(
            folder / "bubble.csv", "t_us,R_um,R_std_um,t_std_us\n" + "".join(f"{k},9,1,1\n" for k in range(4, 9))
        )
        write_text(folder / "gel.yaml", CONFIG)
        prior = build(load_config(folder / "gel.yaml"))[0].prior
        times, settings = FIRST + STEP * np.arange(COUNT), scenery(rng)
        while True:  # a truth that cannot be integrated is drawn again
            truth = prior.mean + prior.std * rng.standard_normal(len(prior.names))
            physical = prior.to_physical(truth[None])[0]
            fixed = {
                f"parameters.{p.name}": f"{v!r} {p.unit}"
                for p, v in zip(prior.parameters, map(float, physical), strict=True)
            }
            try:
                film(load_config(folder / "gel.yaml", fixed), times, folder / "bubble.tif", settings, int(key))
                break
            except En4dvarError:
                continue
        movie = open_movie(folder / "bubble.tif")
        found = track(movie, exposure=EXPOSURE)  # as the command does with --exposure
        write_text(folder / "bubble.csv", to_csv(found.readings, Scale(movie.pixel, movie.rate, EXPOSURE), "", ""))
        try:
            (problem,) = build(load_config(folder / "gel.yaml"))
            analysis = assimilate(problem, AssimilationSettings(what_if=False), int(key))
        except En4dvarError as error:  # counted: no run may fail
            return {"failure": str(error)}
    x = prior.from_physical(analysis.survivors)
    return {
        "truth": truth,
        "mean": x.mean(axis=0),
        "std": x.std(axis=0, ddof=1),
        "rank": np.sum(x < truth, axis=0),
        "warned": [c.code for c in analysis.cautions],
        "frames": sum(r.used for r in found.readings),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--n", type=int, default=100, help="number of movies")
    parser.add_argument("--start", type=int, default=0, help="first seed")
    parser.add_argument("--minutes", type=float, default=np.inf, help="start no experiment after so long")
    parser.add_argument("--records", type=Path, default=Path("runs/movie_to_gel.jsonl"), help="file of the records")
    options = parser.parse_args()
    found = list(
        fill(
            options.records, map(str, range(options.start, options.start + options.n)), experiment, options.minutes
        ).values()
    )
    warned = Counter(code for r in found for code in r.get("warned", ()))
    print(f"{len(found)} movies; warnings: " + ", ".join(f"{code} {n}" for code, n in sorted(warned.items())))
    table(found, ("G", "mu", "R_eq", "R_max", "reading_offset"))


if __name__ == "__main__":
    main()
