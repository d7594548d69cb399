"""A campaign of very many data sets, in a process of its own."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import cheap_model

SCRIPT = """
import resource, sys, time
from en4dvar.runs.runner import run_campaign
peak, first, ended = [], [], set()
def told(name, record):
    first.append(time.process_time()) if not first else None
    ended.add(name)
    if len(ended) == int(sys.argv[3]) // 10 and not peak:
        peak.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3)
settings = {"output.directory": sys.argv[2], "execution.executor": sys.argv[4], "execution.workers": 2}
if __name__ == "__main__":
    campaign = run_campaign(sys.argv[1], overrides=settings, progress=told)
    assert len(campaign) == int(sys.argv[3])
    print(peak[0], resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3, first[0])
"""


def estimate_many(folder: Path, sets: int, executor: str = "serial") -> tuple[float, float, float]:
    """Peak memory (MB) after a tenth of the data sets and at the end, seconds of work to the first estimate.

    Raises
    ------
    AssertionError: it does not end well. subprocess.TimeoutExpired: nor in time.
    """
    path = cheap_model.write_campaign(folder, sets)
    script = folder / "many.py"
    script.write_text(SCRIPT)
    words = [sys.executable, str(script), str(path), str(folder / "run"), str(sets), executor]
    known = {**os.environ, "PYTHONPATH": str(Path(cheap_model.__file__).parent)}
    done = subprocess.run(words, capture_output=True, text=True, env=known, timeout=1500)
    assert done.returncode == 0, done.stderr
    early, late, first = map(float, done.stdout.split())
    return early, late, first
