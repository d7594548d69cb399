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


@pytest.mark.slow
def test_a_script_without_main_guard_gets_one_error(tmp_path: Path) -> None:
    script = tmp_path / "sweep.py"
    script.write_text(TWIN)
    done = subprocess.run([sys.executable, script], cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert done.returncode == 1
    assert done.stderr.count("Traceback") == 1, done.stderr
    assert done.stderr.splitlines()[-1].endswith("put what it does below   if __name__ == '__main__':")
    guarded = TWIN.replace("\nen4dvar.sweep", "\nif __name__ == '__main__': en4dvar.sweep").replace(
        "seeds=1", "seeds=1, resume=True"
    )
    script.write_text(guarded)
    done = subprocess.run([sys.executable, script], cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stderr) == (0, "")
