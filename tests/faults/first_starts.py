"""Many first starts at once: nothing is compiled yet, and all share one cache of compiled code."""

from __future__ import annotations

import subprocess
from pathlib import Path

from run_files import assert_same_results, command, environment

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
CHEAP = ("assimilation.members=8", "assimilation.max_iterations=2", "output.report=false")


def start_together(folder: Path, count: int, config: str = "quickstart") -> int:
    """How many of ``count`` processes, started at once, ended with the bits of a later run that finds all compiled."""
    variables = {"NUMBA_CACHE_DIR": folder / "cache", "HOME": folder}
    settings = [word for key in CHEAP for word in ("--set", key)]

    def start(run: int) -> subprocess.Popen[str]:
        words = command("run", CONFIGS / f"{config}.yaml", "--out", folder / f"run{run}", *settings)
        return subprocess.Popen(words, env=environment(**variables), stderr=subprocess.PIPE, text=True)

    started = [start(i) for i in range(count)]
    told = [process.communicate()[1] for process in started]
    codes = [process.returncode for process in started]
    assert not any(codes), (codes, next(text for text, code in zip(told, codes, strict=True) if code))
    later = start(count)
    _, last = later.communicate()
    assert later.returncode == 0, last
    for i in range(count):
        assert_same_results(folder / f"run{i}", folder / f"run{count}")
    return count
