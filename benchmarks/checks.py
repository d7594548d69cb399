"""What the checks of files and results cost where nothing is wrong: python benchmarks/checks.py [PAIRS] [WORK …]

Each work is done with the checks and with them taken out of the modules that use them, in turn, in pairs of changing
order. Compared is processor time, of child processes too, which another program on the machine hardly changes. Printed
is the median of the ratios of the pairs, with its standard error.
"""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import psutil
import tifffile
from cheap_model import write_campaign

from en4dvar.config import load_config
from en4dvar.report.export import export_table
from en4dvar.results.provenance import cpu_model, git_commit
from en4dvar.runs.runner import run_campaign
from en4dvar_movie.frames import open_movie
from en4dvar_movie.scene import Scene, render
from en4dvar_movie.tracking import track

ROOT = Path(__file__).resolve().parents[1]
SETS, FRAMES = 300, 200


def in_process(
    decoder: Callable[..., Iterator[Any]], path: Path, *arguments: Any, allowed: Any = None
) -> Iterator[Any]:
    """What a decoder gives, without a process of its own."""
    return decoder(path, *arguments)


def opened(path: Path) -> Any:
    """A file, whatever it is."""
    return open(path, "rb")  # as a function that opens


def trusting(self: Any, planned: Any, pack: Any) -> None:
    """Nothing is missing."""


UNCHECKED: Mapping[str, Any] = {
    "en4dvar.results.netcdf.check_seal": lambda path: True,
    "en4dvar.results.netcdf.require_whole": lambda path: None,
    "en4dvar.results.store.check_complete": lambda path, groups: None,
    "en4dvar.results.netcdf.Group.check": lambda self: None,
    "en4dvar.results.run_results.RunResults._look_for": trusting,
    "en4dvar.results.run_results._planned": lambda run_dir: [],
    "en4dvar.results.pack.open_plain": opened,
    "en4dvar.results.pack.digest": lambda content: "",
    "en4dvar.runs.jobs.digest": lambda content: "",
    "en4dvar.results.checkpoint.open_plain": opened,
    "en4dvar.plumbing.files.open_plain": opened,
    "en4dvar.plumbing.decoding.open_plain": opened,
    "en4dvar.config.document.open_plain": opened,
    "en4dvar.runs.rundir.inside": lambda root, name: Path(root) / name,
    "en4dvar.runs.rundir.RunDirectory._refuse_foreign": lambda self, names: None,
    "en4dvar_movie.frames.decoded": in_process,
    "en4dvar_movie.frames.decoded_whole": lambda decoder, path, *rest, allowed=None: next(decoder(path, *rest)),
}


@contextmanager
def unchecked() -> Iterator[None]:
    """Within, nothing that is read is looked at first."""
    with ExitStack() as held:
        for name, instead in UNCHECKED.items():
            held.enter_context(mock.patch(name, instead))
        yield


def one_bubble(folder: Path) -> Callable[[Path], object]:
    """The run of configs/quickstart.yaml, without its page."""
    return lambda out: run_campaign(_to(ROOT / "configs" / "quickstart.yaml", out))


def campaign(folder: Path) -> Callable[[Path], object]:
    """A campaign of a straight line, the cheapest model there is."""
    path = write_campaign(folder, SETS)
    return lambda out: run_campaign(_to(path, out))


def reading(folder: Path) -> Callable[[Path], object]:
    """The export of such a campaign."""
    campaign(folder)(folder / "read")
    return lambda out: export_table(folder / "read")


def movie(folder: Path) -> Callable[[Path], object]:
    """A movie in TIFF, tracked."""
    radii = np.maximum(5, 3 + 38 * np.abs(np.cos(np.pi * np.linspace(0, 1.2, FRAMES) / 2)))
    tifffile.imwrite(folder / "a.tif", np.array(list(render(radii[:, None], Scene(), np.random.default_rng(3)))))
    return lambda out: track(open_movie(folder / "a.tif"))


WORKS = {"one bubble": one_bubble, "campaign": campaign, "its export": reading, "movie": movie}


def _to(path: Path, out: Path) -> Any:
    settings = {"output.directory": str(out), "output.report": False, "execution.executor": "serial"}
    return load_config(path, settings)


def processor_time() -> float:
    """Of this process, of those that have ended and of those that have not, in s."""
    own = psutil.Process()
    times = os.times()
    living = (child.cpu_times() for child in own.children(recursive=True))
    return (
        times.user + times.system + times.children_user + times.children_system + sum(c.user + c.system for c in living)
    )


def main() -> None:
    pairs = int(sys.argv[1]) if len(sys.argv) > 1 else 15
    print(f"commit {git_commit(Path(__file__))}, {pairs} pairs, {cpu_model()}", flush=True)
    print("| work | without the checks | checks |\n|---|---|---|")
    for name in sys.argv[2:] or WORKS:
        with tempfile.TemporaryDirectory() as folder:
            work = WORKS[name](Path(folder))
            taken = np.array([_pair(work, Path(folder), i) for i in range(-1, pairs)])[1:]  # the first compiles
        share = 100 * (taken[:, 0] / taken[:, 1] - 1)
        error = 1.2533 * share.std(ddof=1) / np.sqrt(pairs)  # of a median
        print(f"| {name} | {np.median(taken[:, 1]):.3g} s | {np.median(share):+.1f} ± {error:.1f} % |", flush=True)


def _pair(work: Callable[[Path], object], folder: Path, number: int) -> tuple[float, float]:
    """Processor time with and without."""
    taken = [0.0, 0.0]
    for without in (False, True) if number % 2 else (True, False):
        begin = processor_time()
        with unchecked() if without else ExitStack():
            work(folder / f"out{number}{without}")
        taken[without] = processor_time() - begin
    return taken[0], taken[1]


if __name__ == "__main__":
    main()
