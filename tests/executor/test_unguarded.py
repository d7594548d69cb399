"""A script that starts workers and holds nothing back from them: one error that says what to write."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

TWIN = """
import en4dvar
twin = {
    "name": "twin", "model": {"name": "lorenz63"}, "assimilation": {"scheme": "etkf", "members": 5},
    "twin": {"cycles": 2, "interval": 0.1, "error": {"x_std": 1.0}, "initial_std": {"x": 1.0, "y": 1.0, "z": 1.0}},
}
en4dvar.sweep_twin(twin, {"assimilation.inflation": [1.0, 1.1]}, seeds=1, workers=2)
"""
CALLS = """
from en4dvar.executor import ProcessesExecutor
with ProcessesExecutor(2) as executor:
    list(executor.map(abs, [(-1,), (-2,)]))
"""
CLUSTER = """
from en4dvar.executor.dask import DaskExecutor
with DaskExecutor(2) as executor:
    list(executor.map(abs, [(-1,), (-2,)]))
"""


@pytest.mark.slow
@pytest.mark.parametrize("words", [TWIN, CALLS, CLUSTER])
def test_a_script_without_main_guard_gets_one_line_and_no_traceback(tmp_path: Path, words: str) -> None:
    done = told_by(tmp_path, words)
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert line.endswith("put what it does below   if __name__ == '__main__':")
    guarded = words.replace("\nen4dvar.sweep", "\nif __name__ == '__main__': en4dvar.sweep")
    guarded = guarded.replace("\nwith", "\nif __name__ == '__main__':\n  with").replace("\n    ", "\n      ")
    done = told_by(tmp_path, guarded.replace("seeds=1", "seeds=1, resume=True"))
    assert (done.returncode, done.stderr) == (0, "")


def told_by(folder: Path, words: str) -> subprocess.CompletedProcess[str]:
    script = folder / "script.py"
    script.write_text(words)
    return subprocess.run([sys.executable, script], cwd=folder, capture_output=True, text=True, timeout=120)
