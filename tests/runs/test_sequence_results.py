"""What a sequence has in common with other runs: evidence and comparison, tables, repetition, a kill."""

from __future__ import annotations

import csv
import io
import random
import re
from pathlib import Path

import drift_series
import linear_drift
import numpy as np
import pytest
import xarray as xr
import yaml
from drift_series import STD, TIMES, VALUES
from run_files import kill_after_writes, resumed_until_done, run_cli
from scipy.stats import multivariate_normal

from en4dvar.data.noise import Correlation
from en4dvar.model.state import Parameter
from en4dvar.plumbing.errors import DataError, OutputError
from en4dvar.report.sequence import (
    averaged,
    compare_sequences,
    cycles_table,
    sequence_figures,
    sequences_table,
    symbols,
)
from en4dvar.results.netcdf import Group, read_groups, variable
from en4dvar.results.series_file import MEAN
from en4dvar.runs.cycles import run_sequence
from en4dvar.runs.rerun import rerun
from en4dvar.series.moments import log_evidence

folder = drift_series.folder
RATE, START = 0.2**2 / 0.5, 0.5
BASE = drift_series.BASE | {"assimilation": {"scheme": "etkf", "members": 8, "additive": "square-root"}}


def conducted(name="drift", **changes):
    result = run_sequence({**BASE, **changes, "name": name})
    return Path("runs") / name, result


def exact_evidence():
    """ln N of all readings at once: x = x0 + c t + a random walk, no filter."""
    there = np.isfinite(VALUES)
    t, y = TIMES[there], VALUES[there]
    cov = START**2 + 0.3**2 * np.outer(t, t) + RATE * np.minimum.outer(t, t) + STD**2 * np.eye(len(t))
    return multivariate_normal(0.5 * t, cov).logpdf(y)


def test_evidence_is_that_of_the_readings_together(folder):
    run_dir, result = conducted()
    assert result.log_evidence == pytest.approx(exact_evidence(), abs=1e-10)
    with xr.open_dataset(run_dir / "sequence.nc") as data:
        assert float(data["evidence"].sum()) == pytest.approx(exact_evidence(), abs=1e-10)
    _, smoother = conducted("smoother", assimilation={"scheme": "ienks", "lag": 3, "members": 30})
    assert smoother.log_evidence == pytest.approx(exact_evidence(), abs=1e-10)


@pytest.mark.parametrize(("members", "p"), [(9, 4), (5, 8)])
@pytest.mark.parametrize("correlated", [False, True])
def test_density_of_a_vector_with_gaps(members, p, correlated):
    rng = np.random.default_rng(2)
    ensemble, y = rng.standard_normal((3, members, p)), rng.standard_normal((3, p))
    std = rng.uniform(0.5, 2, (3, p))
    y[1, 2], y[2] = np.nan, np.nan
    c = 0.6 ** np.abs(np.subtract.outer(np.arange(p), np.arange(p))) if correlated else np.eye(p)
    found = log_evidence((y[:, None] - ensemble) / std[:, None], std, Correlation(c) if correlated else None)
    for k in range(2):
        t = np.flatnonzero(np.isfinite(y[k]))
        cov = np.cov(ensemble[k][:, t].T) + np.outer(std[k, t], std[k, t]) * c[np.ix_(t, t)]
        mean = ensemble[k][:, t].mean(axis=0)
        assert found[k] == pytest.approx(multivariate_normal(mean, cov).logpdf(y[k, t]), rel=1e-10)
    assert found[2] == 0  # nothing was observed


@pytest.mark.slow
def test_sequences_are_compared_by_their_evidence(folder):
    right, _ = conducted()
    wrong, _ = conducted("wrong", parameters={"c": {"prior": "normal", "mean": 3, "std": 0.3}})
    one, other = compare_sequences([right, wrong])
    assert other.difference == other.log_evidence - one.log_evidence < -1
    assert one.probability == pytest.approx(1 / (1 + np.exp(other.difference)))
    assert "drift is preferred" in sequences_table((one, other))
    done = run_cli("compare", right, wrong)
    assert done.stdout == sequences_table((one, other)) + "\n", done.stderr


def test_windows_in_which_a_model_is_bent_are_told_beside_their_evidence(folder):
    """The window of a linear model ends with the second iteration, whatever its prior."""
    window = {"scheme": "ienks", "lag": 3, "members": 30}
    right, _ = conducted()
    straight, _ = conducted("straight", assimilation=window)
    assert "caution" not in sequences_table(compare_sequences([right, straight]))
    rate = {"c": {"prior": "lognormal", "median": 0.5, "log_std": 1}}
    filtered, _ = conducted("filtered", parameters=rate)
    windows, _ = conducted("windows", assimilation=window, parameters=rate)
    assert "\ncaution: windows of windows took more than" in sequences_table(compare_sequences([filtered, windows]))


def test_what_has_no_evidence_is_told(folder):
    right, _ = conducted()
    several, result = conducted("several", assimilation={"scheme": "ienks", "lag": 3, "shift": 2, "members": 30})
    assert np.isnan(result.log_evidence)
    with pytest.raises(OutputError, match=r"several: has no evidence to compare: it assimilates .* several times"):
        compare_sequences([right, several])
    more = {**BASE["data"], "error": {"x_std": 0.5}}
    other, _ = conducted("other", data=more)
    with pytest.raises(OutputError, match="other readings or errors"):
        compare_sequences([right, other])
    with pytest.raises(OutputError, match="none: no sequence"):
        compare_sequences([right, Path("none")])
    with pytest.raises(OutputError, match="given twice"):
        compare_sequences([right, right])


@pytest.mark.slow
def test_tables(folder):
    run_dir, result = conducted()
    rows = list(csv.DictReader(io.StringIO(cycles_table(run_dir / "sequence.nc", "csv"))))
    assert len(rows) == 2 * np.isfinite(VALUES).sum()
    assert float(rows[-1]["analysis_mean"]) == pytest.approx(result.run.analysis.mean[-1, 1], rel=1e-9)
    members = list(csv.DictReader(io.StringIO(cycles_table(run_dir / "sequence.nc", "members"))))
    assert [float(row["x"]) for row in members] == pytest.approx(result.run.kept[-1][1][:, 0], rel=1e-9)
    done = run_cli("export", run_dir, "--latex")
    assert done.stdout == cycles_table(run_dir / "sequence.nc", "latex"), done.stderr
    assert done.stdout.count(r"\pm") == 2


def test_repeated_to_the_bit(folder):
    run_dir, _ = conducted()
    found = rerun(run_dir)
    assert (found.same, found.changed, found.surroundings) == (True, "", ())
    assert found.sets[0].variables > 20
    (folder / "drift.csv").write_text((folder / "drift.csv").read_text().replace("0.9", "0.91"))
    changed = rerun(run_dir)
    assert any(words.startswith("/observations differs") for words in changed.sets[0].differ)
    (folder / "drift.csv").unlink()
    with pytest.raises(DataError, match=r"drift\.csv"):
        rerun(run_dir)


@pytest.mark.slow
def test_a_sequence_killed_and_resumed(tmp_path):
    """SIGKILL at random moments of a sequence of a data file; the same bits in the end."""
    rng = np.random.default_rng(1)
    rows = [f"{0.5 * k},{','.join(f'{x:.4f}' for x in rng.standard_normal(2))}" for k in range(1, 61)]
    (tmp_path / "ring.csv").write_text("\n".join(["t,x0,x3", *rows, ""]))
    series = {
        f"at_{k}": {"observable": "x", "columns": {"x": {"name": f"x{k}", "unit": "1"}}, "places": k} for k in (0, 3)
    }
    content = {
        "name": "ring",
        "model": {"name": "twin_models:Ring"},
        "data": {
            "path": "ring.csv",
            "columns": {"time": {"name": "t", "unit": "1"}},
            "error": {"x_std": 0.5},
            "series": series,
        },
        "sequence": {"initial_std": {"x": 0.3, "v": 0.3}},
        "assimilation": {"scheme": "ienks", "lag": 2, "members": 8, "rotation": True},
        "execution": {"checkpoint_every": 0},
        "output": {"report": False},
    }
    path = tmp_path / "ring.yaml"
    path.write_text(yaml.safe_dump(content))
    quiet = run_cli("run", path, "--out", tmp_path / "quiet")
    assert quiet.returncode == 0, quiet.stderr
    draw, done, finished = random.Random(1), 0, 0
    while not done:
        out = tmp_path / f"run{finished}"

        def attempt(resume: tuple[str, ...], out: Path = out) -> tuple[int, str]:
            file, writes = out / "checkpoints" / "sequence.cycle", draw.randint(1, 30)
            return kill_after_writes(file, writes, 0.01, "run", path, "--out", out, *resume, EN4DVAR_TEST_PAUSE=0.003)

        done, finished = done + resumed_until_done(attempt), finished + 1
        with xr.open_dataset(out / "sequence.nc") as a, xr.open_dataset(tmp_path / "quiet" / "sequence.nc") as b:
            assert a.variables.keys() == b.variables.keys()
            assert all(a[name].variable.identical(b[name].variable) for name in a.variables)


def test_a_score_has_the_digits_that_its_scatter_over_the_cycles_allows():
    """RMSE 0.03962 was printed where the next digit but one is chance; scores of neighbouring cycles are alike."""
    rng, found = np.random.default_rng(5), []
    for _ in range(300):
        series = np.zeros(1050)
        for k in range(1, len(series)):
            series[k] = 0.8 * series[k - 1] + rng.standard_normal()
        after = 10 + series[50:]
        score = variable("time", 10 + series, "1", "RMSE", **{MEAN: after.mean()})
        found.append(averaged(Group({"analysis_rmse": score}, attrs={"burn_in": 50}), "analysis_rmse"))
    means, errors = np.array(found).T
    assert 0.85 < np.sqrt(np.mean(errors**2)) / means.std() < 1.15
    single = Group({"s": variable("time", [3.0], "1", "RMSE", **{MEAN: 3.0})}, attrs={"burn_in": 0})
    assert averaged(single, "s") == (3.0, pytest.approx(0.3))


def test_the_page_of_a_sequence_writes_parameters_by_their_symbols(folder, monkeypatch):
    monkeypatch.setattr(linear_drift.Drift, "parameters", (Parameter("c", "1", label="rate", symbol=r"$\kappa$"),))
    run_dir, _ = conducted(output={"report": True})
    page = (run_dir / "report.html").read_text(encoding="utf-8")
    assert '<td class="words">x</td>' in page
    assert '<td class="words"><i>κ</i></td>' in page
    assert "of 1 quantity<" in page
    held = read_groups(run_dir / "sequence.nc")["/"]
    assert [chart.rows[0].panels[0].ylabel for _, _, chart in sequence_figures(held)][:2] == ["x", r"$\kappa$"]
    before = Group(held.variables, {name: v for name, v in held.coords.items() if name != "symbol"}, held.attrs)
    assert symbols(before) == ["x", "c"]  # a file of an earlier version


def test_the_page_of_a_sequence_has_the_digits_of_the_spread(folder):
    run_dir, _ = conducted(output={"report": True})
    page = (run_dir / "report.html").read_text(encoding="utf-8")
    at_end = page.partition("State and parameters at the end")[2].partition("</table>")[0]
    cells = re.findall(r"<td>(−?[0-9.]+)</td><td>([0-9.]+)</td>", at_end)
    assert len(cells) == 2
    for mean, std in cells:
        assert len(mean.partition(".")[2]) == len(std.partition(".")[2])
        assert len(std.partition(".")[2].lstrip("0")) <= 2
