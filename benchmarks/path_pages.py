"""The pictures of the six pages of the documentation's path, and of that of coatings:
``python benchmarks/path_pages.py [FOLDER_OF_PICTURES]``.

Each shows what a reader of the page sees: pages of runs of shipped configurations and of the pages' own examples, as a
headless Chromium draws them. All data are synthetic; the seeds are those of the configurations and of the commands.
"""

from __future__ import annotations

import io
import os
import re
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from PIL import Image

ROOT = Path(__file__).resolve().parents[1]
DATA = ROOT / "configs" / "data"
TRUTH = "parameters={G: 0.42 kPa, alpha: 0.029, mu: 0.086 Pa s, R0: 0.43 um, t_s: 0 us}"
WIDTH, KEPT = 1120, 900  # pixels of a page, and of its picture

Shoot = Callable[[str, str, int], None]


def call(folder: Path, *words: str) -> None:
    environment = {**os.environ, "PYTHONPATH": str(folder)}
    command = [sys.executable, "-m", "en4dvar.cli", *words]
    subprocess.run(command, cwd=folder, check=True, env=environment, stdout=subprocess.DEVNULL)


def files_of(page: str, folder: Path) -> list[list[str]]:
    """Write the files that a page of the documentation shows; its ``en4dvar`` commands."""
    text = (ROOT / "docs" / page).read_text(encoding="utf-8")
    for name, body in re.findall(r"```(?:python|yaml)\n# ([\w.]+)[^\n]*\n(.*?)```", text, re.S):
        (folder / name).write_text(body, encoding="utf-8")
    return [shlex.split(words, comments=True) for words in re.findall(r"^\$ en4dvar (.*)$", text, re.M)]


def first_bubble(folder: Path, shoot: Shoot) -> None:
    """The page of the quick start."""
    call(folder, "run", str(ROOT / "configs" / "quickstart.yaml"), "--out", "runs/quickstart")
    shoot("runs/quickstart/report.html", "path_first_bubble", 1090)


def movie(folder: Path, shoot: Shoot) -> None:
    """The page of a movie that was read."""
    words = ["simulate", str(ROOT / "configs" / "quickstart.yaml"), "--set", TRUTH, "--times", "5.6 us:29.4 us:1.4 us"]
    call(
        folder, *words, "--movie", "bubble.tif", "--movie-set", "shape=192x192", "--movie-set", "noise=1", "--seed", "5"
    )
    call(folder, "track", "bubble.tif", "--out", "bubble.csv")
    shoot("bubble.html", "path_movie", 1280)


def table(folder: Path, shoot: Shoot) -> None:
    """The prior predictive of a configuration that ``init`` proposed."""
    call(folder, "init", "--data", str(DATA / "agarose_synthetic.csv"), "--out", "gel.yaml")
    call(folder, "validate", "gel.yaml", "--plot")
    (picture,) = folder.rglob("*prior*.png")
    keep(Image.open(picture), "path_table", shoot)


def many(folder: Path, shoot: Shoot) -> None:
    """The page of a campaign."""
    files_of("many_bubbles.md", folder)
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    for line in re.findall(r"^\$ (.*)$", (ROOT / "docs" / "many_bubbles.md").read_text(encoding="utf-8"), re.M):
        subprocess.run(line, shell=True, cwd=folder, check=True, env={**os.environ, "PATH": path})
    shoot("runs/gel/report.html", "path_many", 800)


def law(folder: Path, shoot: Shoot) -> None:
    """Radii of bubbles in gels of the law that the page defines."""
    import matplotlib.pyplot as plt

    names = executed("own_constitutive_law.md", "simulate.py", folder)
    figure, axes = plt.subplots(figsize=(6.4, 3.2), layout="constrained")
    for beta, radius in zip(names["values"]["beta"], names["bubbles"].R.values, strict=True):
        axes.plot(names["times"] * 1e6, radius * 1e6, label=f"beta {beta:g}")
    axes.set(xlabel="time (µs)", ylabel="radius (µm)", xlim=(0, 40))
    axes.legend()
    figure.savefig(folder / "law.png", dpi=150)
    keep(Image.open(folder / "law.png"), "path_law", shoot)


def coatings(folder: Path, shoot: Shoot) -> None:
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
    keep(Image.open(folder / "shells.png"), "shells", shoot)


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


def model(folder: Path, shoot: Shoot) -> None:
    """The page of a run of the model that the page defines."""
    for words in files_of("tutorial_own_forward_model.md", folder):
        if "duffing.yaml" in words:
            call(folder, *words)
    shoot("runs/duffing/report.html", "path_model", 1180)


def keep(picture: Image.Image, name: str, shoot: Any) -> None:
    """Smaller than it was seen and in 64 colours: small files."""
    width = min(KEPT, picture.width)
    small = picture.convert("RGB").resize((width, picture.height * width // picture.width), Image.Resampling.LANCZOS)
    small.quantize(64, dither=Image.Dither.NONE).save(shoot.pictures / f"{name}.png", optimize=True)


class Camera:
    """Pictures of pages, by a headless Chromium."""

    def __init__(self, browser: Any, folder: Path, pictures: Path):
        self.browser, self.folder, self.pictures = browser, folder, pictures

    def __call__(self, page: str, name: str, height: int) -> None:
        """The uppermost ``height`` pixels of a page."""
        view = self.browser.new_page(viewport={"width": WIDTH, "height": height}, color_scheme="light")
        view.goto((self.folder / page).as_uri())
        view.wait_for_timeout(500)
        keep(Image.open(io.BytesIO(view.screenshot())), name, self)


def main(pictures: Path, *wanted: str) -> None:
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path="/usr/bin/chromium", args=["--no-sandbox"])
        for step in (first_bubble, movie, table, many, law, coatings, model):
            if not wanted or step.__name__ in wanted:
                with tempfile.TemporaryDirectory() as name:
                    step(Path(name), Camera(browser, Path(name), pictures))
        browser.close()


if __name__ == "__main__":
    main(Path(sys.argv[1]) if sys.argv[1:] else ROOT / "docs" / "assets", *sys.argv[2:])
