"""What the result of a series says of members that were lost, of too few for a window with model error, and of
innovations that are not what they should be.
"""

import numpy as np
import pytest
import xarray as xr
from scipy.linalg import expm
from toys import SLOPE, Swing

import en4dvar

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


@pytest.mark.parametrize("count", [3, 8])
def test_innovations_of_a_right_run_are_not_doubted_however_few_they_are(count):
    """Of a χ² of three to eight readings a root mean square of less than 2/3 is no wonder."""
    told = []
    for seed in range(40):
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
