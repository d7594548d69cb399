"""How often ``en4dvar calibrate`` finds errors that are a fifth larger or smaller than stated, in 100 sets."""

import numpy as np
import pytest
from scipy.stats import binomtest

import en4dvar
from en4dvar.report.calibration import ERRORS

SETS, REPEATS = 100, 60
CONFIG = {
    "name": "line",
    "model": {"name": "trend"},
    "data": {
        "path": "line.csv",
        "columns": {"time": {"name": "t", "unit": "1"}, "x": {"name": "x", "unit": "1"}},
        "error": {"x_std": "0.1"},
    },
    "parameters": {
        "level": {"prior": "normal", "mean": 0, "std": 1},
        "slope": {"prior": "normal", "mean": 1, "std": 0.5},
    },
    "assimilation": {"members": 24},
    "output": {"report": False},
}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("std", "size"),
    [("0.12", "larger"), *(pytest.param(*case, marks=pytest.mark.long) for case in (("0.08", "smaller"), (None, "")))],
)
def test_errors_a_fifth_wrong_are_found_in_a_hundred_sets(tmp_path, monkeypatch, std, size):
    """In all of 60 repetitions, so that the chance is at least 0.95, with 95 % confidence; right errors hardly ever."""
    monkeypatch.chdir(tmp_path)
    t = np.linspace(0, 2, 25)
    (tmp_path / "line.csv").write_text("t,x\n" + "".join(f"{a!r},{a!r}\n" for a in t.tolist()))
    found = 0
    for seed in range(REPEATS):
        result = en4dvar.calibrate(
            {**CONFIG, "seed": seed}, SETS, out=tmp_path / f"{seed}", made_with=std and {"data.error.x_std": std}
        )
        (errors,) = (verdict for verdict in result.verdicts if verdict.quantity == ERRORS)
        found += errors.off and size in errors.words
        assert len(result.good) == SETS
    if std:
        assert binomtest(found, REPEATS).proportion_ci(0.9).low > 0.95
    else:
        assert found <= 3  # 0.6 at most are expected at the level of 0.01
