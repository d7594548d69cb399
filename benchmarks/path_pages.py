"""The pictures of the six pages of the documentation's path, and of that of coatings:
``python benchmarks/path_pages.py [FOLDER_OF_PICTURES]``.

Each shows what a reader of the page sees: pages of runs of shipped configurations and of the pages' own examples, as a
headless Chromium draws them. All data are synthetic; the seeds are those of the configurations and of the commands.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

from pictures import DATA, ROOT, Camera, call, files_of, follow, take
from PIL import Image

TRUTH = "parameters={G: 0.42 kPa, alpha: 0.029, mu: 0.086 Pa s, R0: 0.43 um, t_s: 0 us}"


def first_bubble(folder: Path, shoot: Camera) -> None:
    """The page of the quick start."""
    call(folder, "run", str(ROOT / "configs" / "quickstart.yaml"), "--out", "runs/quickstart")
    shoot("runs/quickstart/report.html", "path_first_bubble", 1090)


def movie(folder: Path, shoot: Camera) -> None:
    """The page of a movie that was read."""
    words = ["simulate", str(ROOT / "configs" / "quickstart.yaml"), "--set", TRUTH, "--times", "5.6 us:29.4 us:1.4 us"]
    call(
        folder, *words, "--movie", "bubble.tif", "--movie-set", "shape=192x192", "--movie-set", "noise=1", "--seed", "5"
    )
    call(folder, "track", "bubble.tif", "--out", "bubble.csv")
    shoot("bubble.html", "path_movie", 1280)


def table(folder: Path, shoot: Camera) -> None:
    """The prior predictive of a configuration that ``init`` proposed."""
    call(folder, "init", "--data", str(DATA / "agarose_synthetic.csv"), "--out", "gel.yaml")
    call(folder, "validate", "gel.yaml", "--plot")
    (picture,) = folder.rglob("*prior*.png")
    shoot.keep(Image.open(picture), "path_table")


def many(folder: Path, shoot: Camera) -> None:
    """The page of a campaign."""
    follow("many_bubbles.md", folder)
    shoot("runs/gel/report.html", "path_many", 800)


def law(folder: Path, shoot: Camera) -> None:
    """Radii of bubbles in gels of the law that the page defines."""
    import matplotlib.pyplot as plt

    names = executed("own_constitutive_law.md", "simulate.py", folder)
    figure, axes = plt.subplots(figsize=(6.4, 3.2), layout="constrained")
    for beta, radius in zip(names["values"]["beta"], names["bubbles"].R.values, strict=True):
        axes.plot(names["times"] * 1e6, radius * 1e6, label=f"beta {beta:g}")
    axes.set(xlabel="time (µs)", ylabel="radius (µm)", xlim=(0, 40))
    axes.legend()
    figure.savefig(folder / "law.png", dpi=150)
    shoot.keep(Image.open(folder / "law.png"), "path_law")


def coatings(folder: Path, shoot: Camera) -> None:
    """Tension and radius of coated bubbles, as the page of coatings computes them."""
    import matplotlib.pyplot as plt

    names = executed("shells.md", "coatings.py", folder)
    figure, (left, right) = plt.subplots(1, 2, figsize=(7.6, 3.0), layout="constrained")
    for name, style in zip(names["laws"], ("-", "--", ":"), strict=True):
        left.plot(names["stretch"], names["tensions"][name] * 1e3, style, label=name)
        right.plot(names["times"] * 1e6, names["radii"][name] * 1e6, style)
    left.set(xlabel="R / R0", ylabel="tension (mN/m)", ylim=(-40, 110))
    right.set(xlabel="time (µs)", ylabel="radius (µm)")
    left.legend(fontsize="small", loc="lower right")
    figure.savefig(folder / "shells.png", dpi=150)
    shoot.keep(Image.open(folder / "shells.png"), "shells")


def executed(page: str, script: str, folder: Path) -> dict[str, Any]:
    """The names that a script shown on a page has when it has run."""
    files_of(page, folder)
    names: dict[str, Any] = {}
    here = Path.cwd()
    try:
        os.chdir(folder)
        exec((folder / script).read_text(encoding="utf-8"), names)
    finally:
        os.chdir(here)
    return names


def model(folder: Path, shoot: Camera) -> None:
    """The page of a run of the model that the page defines."""
    for words in files_of("tutorial_own_forward_model.md", folder):
        if "duffing.yaml" in words:
            call(folder, *words)
    shoot("runs/duffing/report.html", "path_model", 1180)


if __name__ == "__main__":
    take((first_bubble, movie, table, many, law, coatings, model), sys.argv[1:])
