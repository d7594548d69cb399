"""``en4dvar warm-up``: afterwards nothing is compiled any more, whatever is run."""

from __future__ import annotations

import json
import subprocess
import sys
from importlib.metadata import EntryPoint

import pytest
from click.testing import CliRunner
from run_files import TESTS, environment

from en4dvar.cli import main
from en4dvar.commands import plugins

CONFIGS = TESTS.parent / "configs"
AFTERWARDS = """
import json, sys
import numpy as np
from click.testing import CliRunner
from en4dvar.cli import main
from en4dvar.plumbing.compiled import KERNELS

def used():
    return {f"{kernel.__name__}{signature}" for kernel in KERNELS for signature in kernel.signatures}

def command(*words):
    result = CliRunner().invoke(main, words)
    assert result.exit_code == 0, (words, result.output, result.exception)
    return result.output

told = command("warm-up")
inner = {name for kernel in KERNELS for name in kernel.py_func.__code__.co_names}  # compiled within what calls them
unused = [kernel.__name__ for kernel in KERNELS if not kernel.signatures and kernel.__name__ not in inner]
before = used()
configs, folder = sys.argv[1:]
few = ("--set", "assimilation.members=8", "--set", "assimilation.max_iterations=2", "--no-report")
for name in ("quickstart", "predator_prey", "lorenz63_ienks"):
    command("run", f"{configs}/{name}.yaml", "--out", f"{folder}/{name}", *few)

from en4dvar_bubble import Accuracy, BubbleModel, REGISTRY, get_law
for name in REGISTRY:
    law = get_law(name)
    for start, radii in (("acoustic", {"R0": 1e-6}), ("laser", {"R_eq": 4e-5, "R_max": 2e-4})):
        if law.released and start == "acoustic":
            continue
        for options in ({}, {"gas": "polytropic"}, {"accuracy": Accuracy(nodes=24)}, {"radial": "gilmore"}):
            model = BubbleModel(law, start=start, **options)
            values = {**law.example_values(3), **{key: np.full(3, value) for key, value in radii.items()}}
            paths = model.trajectories(model.initial_states(values), np.linspace(1e-7, 2e-6, 5))
            [getattr(path, "states", path) for path in paths]

print(json.dumps({"told": told, "unused": unused, "after": sorted(used() - before)}))
"""


@pytest.mark.slow
def test_nothing_is_compiled_after_it(tmp_path):
    words = [sys.executable, "-c", AFTERWARDS, str(CONFIGS), str(tmp_path)]
    done = subprocess.run(words, capture_output=True, text=True, env=environment())
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    assert found["unused"] == []
    assert found["after"] == []
    assert "bubble, heat, 4 nodes: " in found["told"]
    assert "compiled code is kept below " in found["told"]


def test_a_package_that_cannot_be_loaded_is_one_error(monkeypatch):
    entry = EntryPoint("own", "toy_models:nothing_there", plugins.WARM_UP)
    monkeypatch.setattr(plugins, "installed", lambda group: {"own": entry})
    outcome = CliRunner().invoke(main, ["warm-up"])
    assert outcome.exit_code == 1
    assert "warm-up of 'own' (toy_models:nothing_there) cannot be loaded: " in outcome.output
