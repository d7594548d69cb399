"""A mistake in a scheme of one's own ends in a sentence that names the scheme, its method and what that gives."""

import numpy as np
import pytest
from click.testing import CliRunner

import en4dvar
from en4dvar.cli import main
from en4dvar.plumbing.errors import ConfigError

pytestmark = pytest.mark.usefixtures("schemes_as_before")

BEGIN = """from dataclasses import dataclass
import numpy as np
from en4dvar.schemes import ETKF
from en4dvar.schemes.base import Step, Weights, gauss_newton

@dataclass(frozen=True)
class Bad(ETKF):
    words = "bad"
    on = ("window", "series")

    def advance(self, weights, evaluation, iteration, draw):
        return gauss_newton(weights.w, evaluation)
"""
STEP = "    def advance(self, weights, evaluation, iteration, draw):\n        s = gauss_newton(weights.w, evaluation)\n"
CASES = [
    (
        "    def members(self, weights):\n        return weights.w",
        "members gives shape (16,); it gives finite numbers of",
    ),
    (
        "    def members(self, weights):\n        return weights.rows[:, :4]",
        "members gives shape (16, 4); it gives fini",
    ),
    (
        "    def members(self, weights):\n        return np.nan * weights.rows",
        "members gives shape (16, 16); it gives fin",
    ),
    ("    def members(self, weights):\n        return weights.row", "members raises AttributeError: "),
    ("    def members(self):\n        return 1", "members raises TypeError: Bad.members() takes 1 positional argument"),
    (
        "    def members(self, weights):\n        return weights.rows[:7]",
        "linearise gives [(9,), (7, 9)]; it gives a pai",
    ),
    (
        "    def linearise(self, weights, runs):\n        return runs.predictions",
        "linearise gives ndarray; it gives a pair",
    ),
    (
        "    def linearise(self, weights, runs):\n        return [runs.predictions, runs.predictions]",
        "linearise gives [(16, 9), (16, 9)]; it gives a pair",
    ),
    (
        "    def linearise(self, weights, runs):\n        raise ValueError('no')",
        "linearise raises ValueError: no ({0}:15)",
    ),
    (
        "    def linearise(self, weights, runs):\n        return np.full(9, np.inf), runs.predictions",
        "linearise gives [(9,), (16, 9)]; it gives a pair of arrays of finite numbers, of shapes (9,) and (16, 9)",
    ),
    (
        f"{STEP}        return Step(Weights(s.w, s.transform[:3]), s.norm)",
        "advance gives weights (16,), transform (3, 16) and norm (); they are (16,), (16, 16) and a number",
    ),
    (
        f"{STEP}        return Step(Weights(s.w, None), s.norm)",
        "advance gives a transform of type NoneType; it is a num",
    ),
    (
        f"{STEP}        return Step(Weights(s.w, s.transform.tolist()), s.norm)",
        "advance gives a transform of type list; it is a numpy array of shape (16, 16)",
    ),
    (f"{STEP}        return Step(s.w, s.norm)", "advance gives Step(weights=array("),
    (
        f"{STEP}        return Step(Weights(np.nan * s.w, s.transform), s.norm)",
        "advance gives weights, a transform or a",
    ),
    (
        f"{STEP}        return Step(Weights(s.w, np.nan * s.transform), s.norm)",
        "advance gives weights, a transform or a",
    ),
    (
        f"{STEP}        return Step(Weights(s.w, s.transform), np.nan)",
        "advance gives weights, a transform or a norm that a",
    ),
    (
        "    def done(self, iteration, step):\n        return 1 / 0",
        "done raises ZeroDivisionError: division by zero ({0}:15)",
    ),
    (
        "    def done(self, iteration, step):\n        return False",
        "done is not true after 160 iterations; a scheme that ",
    ),
    ("    passes = 0", "done is not true after 160 iterations"),
    (
        "    max_iterations: int = 180\n    def done(self, iteration, step):\n        pass",
        "done is not true after 180 itera",
    ),
]


def written(folder, lines):
    (folder / "bad.py").write_text(f"{BEGIN}\n{lines}\n")
    return f"{folder / 'bad.py'}:Bad"


def estimated(scheme, **keys):
    t, priors = np.linspace(0, 2, 9), {name: {"prior": "normal", "mean": 0, "std": 1} for name in "ab"}
    assimilation = {"scheme": scheme, "members": 16, **keys}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("en4dvar.schemes.asked.MOST", 160)  # of 1000
        en4dvar.estimate(lambda p, t: p["a"] + p["b"] * t, (t, t), priors, error=0.1, assimilation=assimilation)


@pytest.mark.parametrize(("lines", "words"), CASES)
def test_the_scheme_and_its_method_are_named(tmp_path, lines, words):
    with pytest.raises(ConfigError) as caught:
        estimated(written(tmp_path, lines))
    assert f"scheme Bad: {words}".format(tmp_path / "bad.py") in str(caught.value)


SLOWLY = f"{STEP}        return Step(Weights(weights.w + 0.05 * (s.w - weights.w), s.transform), s.norm)\n"


@pytest.mark.parametrize(
    ("lines", "keys"),
    [
        ("    def linearise(self, weights, runs):\n        return [*super().linearise(weights, runs)]", {}),
        ("    max_iterations: int | None = None", {}),
        ("    patience: int", {"patience": 3}),
        (f"{SLOWLY}    def done(self, iteration, step):\n        return iteration == 150", {}),
        (
            f"    steps: int = 170\n{SLOWLY}    def done(self, iteration, step):\n"
            "        return iteration + 1 == self.steps",
            {},
        ),
    ],
    ids=["list", "none", "given", "150", "own-key"],
)
def test_what_is_no_mistake_runs(tmp_path, lines, keys):
    """A list for a pair; a limit that may be none; a key without a default that is given; more than 100 iterations."""
    estimated(written(tmp_path, lines), **keys)


@pytest.mark.parametrize("localisation", ["", "  localisation: {radius: 4}\n"])
@pytest.mark.parametrize(
    ("lines", "words"),
    [
        (
            "    lag = 1\n    filters = False\n    def done(self, iteration, step):\n        return False",
            "done is not true after 40 iterations",
        ),
        (
            "    def linearise(self, weights, runs):\n        return runs.predictions",
            "linearise gives ndarray; it gives a",
        ),
    ],
)
def test_on_a_series_too(tmp_path, monkeypatch, localisation, lines, words):
    monkeypatch.setattr("en4dvar.schemes.asked.MOST", 40)  # of 1000
    (tmp_path / "twin.yaml").write_text(
        "name: twin\nseed: 1\nmodel: {name: lorenz96}\n"
        "twin: {cycles: 3, burn_in: 0, interval: 0.05, error: {x_std: 1}, initial_std: {x: 0.03}}\n"
        f"assimilation:\n  scheme: {written(tmp_path, lines)}\n  members: 12\n{localisation}"
    )
    done = CliRunner().invoke(main, ["run", str(tmp_path / "twin.yaml"), "--out", str(tmp_path / "run")])
    assert f"scheme Bad: {words}" in done.output


def test_a_key_without_a_default_is_refused(tmp_path):
    scheme = written(tmp_path, "@dataclass(frozen=True)\nclass Eager(ETKF):\n    patience: int\n").replace(
        "Bad", "Eager"
    )
    with pytest.raises(ConfigError, match="'patience' of Eager has no default; give the key here, or a default"):
        estimated(scheme)
