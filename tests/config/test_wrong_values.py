"""Whatever stands where it cannot: every value of a configuration of each kind is replaced, one at a time.

What is wrong at one place is one message with file, line and column. What it says is tested where the key is.
"""

from __future__ import annotations

import itertools
import re
import shutil
from collections.abc import Callable, Iterator
from copy import deepcopy
from pathlib import Path
from typing import Any

import drift_series
import pytest
import yaml
from field_models import write_line
from toy_config import write_toy

from en4dvar.plumbing.errors import ConfigError, DataError
from en4dvar.runs.checks import validate

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
WRONG = ["nonsense", -1, float("nan"), 1e300, True, None, "", ["x"], "3 kg"]  # of them each key gets two, in turn
folder = drift_series.folder


def priors(folder: Path) -> Any:
    c = "  c: {prior: uniform, lower: 0 N s/m, upper: 0.1 N s/m}\n"
    found = yaml.safe_load(write_toy(folder, ("  c: 0.02 N s/m\n", c)).read_text())
    found["parameters"]["t_s"] = {"prior": "half-normal", "std": "1 ms", "lower": "0 ms"}
    found["parameters"]["sigma"] = {"prior": "beta", "lower": 0.5, "upper": 2, "alpha": 2, "beta": 2}
    pair, line = {"between": ["k", "A"], "correlation": 0.3}, {"kernel": "gaussian", "at": [0, 1], "length": 0.5}
    found["prior_correlation"] = [pair, {"between": ["k", "c"], **line}]
    return found


def field(folder: Path) -> Any:
    placed = ("radius: 300 cm", "radius: 300 cm, at: {offset: 50 cm}")
    uncertain = ("offset: 0", "offset: {prior: normal, mean: 0, std: 1}")
    return yaml.safe_load(write_line(folder, placed, uncertain).read_text())


def shipped(folder: Path, name: str) -> Any:
    for part in ("data", "programs"):
        shutil.copytree(CONFIGS / part, folder / part, ignore=shutil.ignore_patterns("agarose*", "combined*"))
    return yaml.safe_load((CONFIGS / f"{name}.yaml").read_text())


def series(folder: Path) -> Any:
    found = shipped(folder, "predator_prey")
    found["data"]["series"]["ln_prey"] |= {"group": "pelts", "weights": [1] * 21}
    found["assimilation"]["weights"] = "balanced"
    found["parameters"]["delta"] = {"tied": "beta", "factor": 0.9}
    return found


def program(folder: Path) -> Any:
    found = shipped(folder, "external_program")
    found["model"] |= {"retries": 1, "environment": {"A": "b"}, "files": ["data/oscillator.csv"], "scratch": "."}
    found["model"]["parameters"]["A"] = {"unit": "m", "lower": 0, "upper": 1, "label": "amplitude"}
    return found


def sequence(_: Path) -> Any:
    walk = drift_series.BASE["parameters"]["c"] | {"varies": {"std": 0.1, "every": 2}}
    window = {"scheme": "ienks", "members": 8, "lag": 2, "shift": 1, "mda_weights": [1, 1], "inflation": 1.01}
    return deepcopy(drift_series.BASE | {"parameters": {"c": walk}, "assimilation": window})


KINDS: dict[str, tuple[Callable[[Path], Any], tuple[str, ...]]] = {
    "priors": (priors, ("parameters", "prior_correlation")),
    "series": (series, ("data", "parameters.delta", "assimilation")),
    "field": (field, ("initial_state", "assimilation")),
    "program": (program, ("model",)),
    "sequence": (sequence, ("parameters", "sequence", "model_error", "assimilation")),
}


def places(content: Any, above: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    for key, value in content.items() if isinstance(content, dict) else enumerate(content[:2]):
        yield (*above, key)
        if isinstance(value, dict | list):
            yield from places(value, (*above, key))


def with_value(content: Any, place: tuple[Any, ...], value: object) -> Any:
    changed = inner = deepcopy(content)
    for key in place[:-1]:
        inner = inner[key]
    inner[place[-1]] = value
    return changed


def told(path: Path) -> str:
    """What is said of a file; "" where nothing is."""
    try:
        validate(path)
    except (ConfigError, DataError) as error:
        return str(error)
    return ""


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("kind", KINDS)
def test_a_wrong_value_is_one_located_message(kind: str, folder: Path) -> None:
    make, sections = KINDS[kind]
    content, path, turn = make(folder), folder / "case.yaml", itertools.cycle(WRONG)
    path.write_text(yaml.safe_dump(content))
    assert told(path) == ""
    refused = 0
    for place in [place for place in places(content) if ".".join(map(str, place)).startswith(sections)]:
        for value in itertools.islice(turn, 2):
            path.write_text(yaml.safe_dump(with_value(content, place, value)))
            found, what = told(path), f"{place}: {value!r}"
            if found:
                assert len(found.splitlines()) == 1, f"{what}: {found}"
                assert re.match(rf"{re.escape(str(path))}:\d+:\d+: ", found), f"{what}: {found}"
                refused += 1
    assert refused > 20
