"""What the result of a series says of members that were lost, of too few for a model error, of innovations that are not
what they should be, of constants that chance makes too sure, and of windows that end in a wrong minimum.
"""

import re

import numpy as np
import pytest
import xarray as xr
from scipy.linalg import expm
from toys import SLOPE, Swing

import en4dvar
from en4dvar import Field, ForwardModel, Observable, Parameter, StateField, StateLayout
from en4dvar_lorenz import Lorenz63

TIMES = np.arange(1.0, 9.0) / 2
READ = np.array([(expm(SLOPE * t) @ [1.1, 0.2])[0] for t in TIMES])


class Breaking(Swing):
    def step(self, x, t0, t1):
        if x[0] > 1.2 and t0 < 0.2:
            raise RuntimeError("breaks")
        return super().step(x, t0, t1)


def followed(model, scheme, members, directory=None, read=(TIMES, READ), error=0.1, **sections):
    return en4dvar.estimate_sequence(
        model, {"x": read}, error={"x": error}, initial_std={"x": "0.5 m", "v": "0.4 m/s"},
        assimilation={"scheme": scheme, "members": members, **sections.pop("keys", {})}, directory=directory,
        **sections,
    )  # fmt: skip


@pytest.mark.parametrize("keys", [{"scheme": "etkf"}, {"scheme": "ienks", "keys": {"lag": 2}}])
def test_members_lost_are_told_once_with_why_and_when(keys, tmp_path):
    result = followed(Breaking, members=40, directory=tmp_path / "run", **keys)
    lost = len(result.run.failures)
    assert lost > 2
    (words,) = [words for words in result.warnings if "lost" in words]
    assert words.startswith(f"{lost} of 40 members were lost: RuntimeError: breaks (t = 0 to 0.5) (")
    assert "\n".join(result.warnings) == xr.open_dataset(tmp_path / "run" / "sequence.nc").attrs["warnings"]
    assert not [words for words in followed(Swing, members=40, **keys).warnings if "lost" in words]


@pytest.mark.parametrize(("lag", "needed"), [(3, 2 + 3 + 1), (40, 2 + 8 + 1)])
def test_a_window_says_how_many_members_its_model_error_needs(lag, needed):
    """With as many its spread is that of many; one fewer and it is told."""
    keys = {"keys": {"lag": lag}, "model_error": {"v": {"std": "0.5 m/s", "every": "2 s"}}}
    few, enough, many = (followed(Swing, "ienks", n, **keys) for n in (needed - 1, needed, 60))
    np.testing.assert_allclose(enough.run.smoothed.std, many.run.smoothed.std, rtol=1e-9)
    assert np.max(np.abs(few.run.smoothed.std / many.run.smoothed.std - 1)) > 0.01
    words = f"{needed - 1} members are fewer than the {needed} that a window of {min(lag, 8)} times with model error"
    assert few.warnings[0].startswith(words)
    assert not [words for words in enough.warnings if "fewer" in words]


class Still(ForwardModel):
    """Four variables that stay as they are; the first is read."""

    parameters = ()
    layout = StateLayout(tuple(Field(name) for name in "abcd"))
    observables = (Observable("a", "1", StateField("a")),)
    time_unit = "1"

    def initial_state(self, theta):
        return np.zeros(4)

    def step(self, x, t0, t1):
        return x


@pytest.mark.parametrize("scheme", ["etkf", "esrf"])
def test_a_square_root_says_how_many_members_it_needs(scheme):
    """With as many the spread of what is read is that of the Kalman filter; with one fewer it is told."""
    few, enough = (
        en4dvar.estimate_sequence(
            Still, {"a": (TIMES, READ)}, error={"a": 0.5}, initial_std=dict.fromkeys("abcd", 0.5),
            model_error={"a": {"std": 0.3, "every": 1}},
            assimilation={"scheme": scheme, "members": members, "additive": "square-root"},
        )
        for members in (4, 5)
    )  # fmt: skip
    variance = 0.25
    for _ in TIMES:
        variance = 1 / (1 / (variance + 0.09 * 0.5) + 1 / 0.25)
    assert enough.run.analysis.std[-1, 0] == pytest.approx(np.sqrt(variance), rel=1e-9)
    assert few.run.analysis.std[-1, 0] < 0.97 * np.sqrt(variance)
    assert few.warnings[0].startswith("4 members are fewer than the 5 that a model error by a square root needs")
    assert not [words for words in enough.warnings if "fewer" in words]


@pytest.mark.parametrize("scheme", ["etkf", "ienks"])
def test_a_state_says_how_many_members_it_needs(scheme):
    """With as many mean and spread are those of the Kalman filter; with one fewer they are not, which is told."""
    few, enough = (
        en4dvar.estimate_sequence(
            Still, {"a": (TIMES, READ)}, error={"a": 0.5}, initial_std=dict.fromkeys("abcd", 0.5),
            assimilation={"scheme": scheme, "members": members},
        )
        for members in (4, 5)
    )  # fmt: skip
    assert enough.run.analysis.std[-1] == pytest.approx([0.5 / 3, 0.5, 0.5, 0.5], rel=1e-9)
    assert enough.run.analysis.mean[-1, 0] == pytest.approx(READ.sum() / 9, rel=1e-9)
    assert np.max(np.abs(few.run.analysis.std[-1] / enough.run.analysis.std[-1] - 1)) > 0.1
    (told,) = few.warnings
    assert told.startswith("4 members are fewer than the 5 that a state of 4 uncertain numbers needs")
    assert enough.warnings == ()


@pytest.mark.parametrize("count", [3, 8])
def test_innovations_of_a_right_run_are_not_doubted_however_few_they_are(count):
    """Of a χ² of three to eight readings a root mean square of less than 2/3 is no wonder."""
    told = []
    for seed in range(16):
        rng = np.random.default_rng(seed)
        start, when = [1, 0] + np.array([0.5, 0.4]) * rng.standard_normal(2), TIMES[:count]
        read = np.array([(expm(SLOPE * t) @ start)[0] for t in when]) + 0.1 * rng.standard_normal(count)
        told += followed(Swing, "etkf", 8, read=(when, read)).warnings
    assert told == []


@pytest.mark.parametrize(("factor", "words"), [(10, "are only"), (0.1, "times as large")])
def test_errors_that_are_far_too_large_or_small_are_told(factor, words):
    read = READ + 0.1 * np.random.default_rng(1).standard_normal(8)
    (told,) = followed(Swing, "etkf", 8, read=(TIMES, read), error=0.1 * factor).warnings
    assert words in told


@pytest.mark.parametrize("stated", [0.75, 1.0])
def test_innovations_a_third_too_large_are_told_where_they_are_many(stated):
    """Of 400 readings a root mean square of 1.33 is no chance, as of a filter that has become too sure: 1.2 is told."""
    when = 0.05 * np.arange(1, 401)
    read = np.array([(expm(SLOPE * t) @ [1, 0])[0] for t in when]) + 0.1 * np.random.default_rng(7).standard_normal(400)
    told = followed(Swing, "etkf", 8, read=(when, read), error=0.1 * stated).warnings
    assert [words for words in told if "too sure of" in words] == list(told)
    assert len(told) == (stated < 1)


class Bystander(ForwardModel):
    """A variable that is read, doubles and changes its sign at random, and a constant that nothing depends on."""

    parameters = (Parameter("c", "1"),)
    layout = StateLayout((Field("a"), Field("c")))
    observables = (Observable("a", "1", StateField("a")),)
    time_unit = "1"

    def initial_state(self, theta):
        return np.array([0.0, theta["c"]])

    def step(self, x, t0, t1):
        return np.array([3.7 * np.sin(x[0]), x[1]])


def stood_by(scheme, seed=0, varies=None, **keys):
    rng = np.random.default_rng(seed)
    read = [rng.standard_normal()]
    for _ in range(79):
        read.append(3.7 * np.sin(read[-1]))
    return en4dvar.estimate_sequence(
        Bystander, {"a": (np.arange(80.0), np.array(read) + rng.standard_normal(80))},
        {"c": {"prior": "normal", "mean": 0, "std": 1, **({"varies": varies} if varies else {})}},
        error={"a": 1}, initial_std={"a": 1},
        assimilation={"scheme": scheme, "members": 20, **keys}, seed=seed,
    )  # fmt: skip


def test_perturbed_observations_that_move_and_narrow_a_constant_are_told():
    """Its posterior is its prior, N(0, 1): the error of a mean m is that of a truth drawn from it, √(1 + m²)."""
    runs = [stood_by("enkf", seed) for seed in range(6)]
    mean, std = (np.array([vars(r.run.analysis)[name][-1, 1] for r in runs]) for name in ("mean", "std"))
    told = runs[0].warnings[0]
    excess, enough = map(float, re.findall(r"off by (\S+) times its spread; give inflation: (\S+),", told)[0])
    assert told.startswith("perturbed observations move and narrow c by chance")
    assert 0.5 < excess / np.sqrt(np.mean((1 + mean**2) / std**2)) < 2
    assert excess > 5
    assert stood_by("enkf", inflation=enough).warnings == ()


@pytest.mark.parametrize("keys", [{"scheme": "etkf"}, {"scheme": "enkf", "varies": {"std": 1, "every": 1}}])
def test_what_is_not_perturbed_or_not_constant_is_not_told_so(keys):
    assert "perturbed" not in "".join(stood_by(**keys).warnings)


def test_windows_that_end_in_a_wrong_minimum_are_told():
    """Forecasts of Lorenz-63 over all of twelve time units are so wide that no innovation is too large."""
    times, rng = 0.25 * np.arange(1, 49), np.random.default_rng(0)
    start = np.array([[1.6, -1.4, 25.1, 10, 28, 8 / 3]])
    (path,) = Lorenz63.from_settings(Lorenz63.Settings()).trajectories(start, times)
    read = path.states[:, :3] + rng.standard_normal((48, 3))

    def along(lag, **keys):
        return en4dvar.estimate_sequence(
            "lorenz63", {name: (times, read[:, j]) for j, name in enumerate("xyz")}, {}, error=dict.fromkeys("xyz", 1),
            initial_std=dict.fromkeys("xyz", 1),
            assimilation={"scheme": "ienks", "members": 12, "lag": lag, "shift": lag, **keys},
        )  # fmt: skip

    whole = along(48)
    assert np.sqrt(np.nanmean(whole.normalised**2)) < 1.2
    size = np.sqrt(np.mean((read - whole.run.analysis.mean[:, :3]) ** 2))
    assert size > 5
    unsettled, told = whole.warnings
    assert unsettled.startswith("1 of 1 cycle ended at max_iterations before they had settled, the worst at 12 with")
    assert told.startswith(f"residuals of the analyses are {size:.2g} times the errors: windows have ended in a wrong")
    assert along(2).warnings == along(2, max_iterations=1).warnings == ()
