"""What a model declares of parameters that a file need not name."""

import numpy as np
import pytest
import yaml
from click.testing import CliRunner

from en4dvar.cli import main

MODEL = """import numpy as np
from en4dvar.model.forward import ForwardModel, Observable, StateField
from en4dvar.model.state import Field, Parameter, StateLayout

class Own(ForwardModel):
    parameters = (Parameter("a", "1"), Parameter("b", "1"))
    optional_parameters = (Parameter("c", "1"),)
    layout = StateLayout((Field("y"), Field("a"), Field("b")))
    observables = (Observable("y", "1", StateField("y")),)
    defaults = {DEFAULTS}

    def initial_state(self, theta):
        return np.array([theta["a"], theta["a"], theta["b"]])

    def step(self, x, t0, t1):
        return np.array([x[1] + x[2] * t1, x[1], x[2]])
"""
NORMAL = {"prior": "normal", "mean": 1, "std": 0.5}
DATA = {
    "path": "data.csv",
    "columns": {"time": {"name": "t", "unit": "s"}, "y": {"name": "y", "unit": "1"}},
    "error": {"y_std": 0.1},
}
WINDOW = {"data": DATA, "assimilation": {"members": 16, "what_if": False, "refine": "none"}}
TWIN = {
    "twin": {"cycles": 3, "burn_in": 0, "interval": "0.1 s", "error": {"y_std": 0.1}, "initial_std": {"y": 0.1}},
    "assimilation": {"scheme": "etkf", "members": 8},
}


def run(folder, defaults, sections, **parameters):
    (folder / "own.py").write_text(MODEL.replace("{DEFAULTS}", defaults))
    (folder / "data.csv").write_text("t,y\n" + "".join(f"{t},{1 + t}\n" for t in np.linspace(0.1, 2, 9)))
    named = {"model": {"name": "./own.py:Own"}, "parameters": {"a": NORMAL, **parameters}}
    (folder / "own.yaml").write_text(yaml.safe_dump({"name": "own", "seed": 1, **named, **sections}))
    done = CliRunner().invoke(main, ["run", str(folder / "own.yaml"), "--out", str(folder / "run")])
    assert done.exit_code == 0, done.output + repr(done.exception)


@pytest.mark.parametrize("name", ["sigma", "t_s", "reading_offset", "reading_scale", "c"])
@pytest.mark.parametrize("sections", [WINDOW, TWIN], ids=["window", "twin"])
def test_they_may_be_of_the_readings_and_of_optional_parameters(tmp_path, name, sections):
    """Where there are no such readings, or the optional one is no parameter, they say nothing."""
    run(tmp_path, f"{{'{name}': 1.5}}", sections, b={**NORMAL})


@pytest.mark.parametrize("value", ["np.float32(1)", "np.int64(1)", "np.float64(1)"])
def test_they_may_be_numbers_of_numpy(tmp_path, value):
    run(tmp_path, f"{{'b': {value}}}", WINDOW)
