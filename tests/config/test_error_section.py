"""``data.error``, ``sigma`` and ``initial_state`` from YAML to the result file; every mistake is located."""

import re
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from toy_config import csv_text, write_toy

from en4dvar.assembly.build import build
from en4dvar.cli import main
from en4dvar.config import load_config
from en4dvar.data.noise import CorrelatedNoise
from en4dvar.plumbing.errors import ConfigError, DataError
from en4dvar.report.result import load_result
from en4dvar.results.provenance import identity

ERROR = "position_std: 2 um"
CORRELATED = (ERROR, "position_std: 2 um, correlation_time: 20 ms, time_std: 10 us")
FROM_FILE = (ERROR, "covariance: {path: R.csv, unit: um^2}")
STATE = ("assimilation:\n", "initial_state:\n  v: {std: 0.2 m/s}\n  x: {std: 5 %}\nassimilation:\n")


def observations(tmp_path: Path, *replacements: tuple[str, str]):
    (problem,) = build(load_config(write_toy(tmp_path, *replacements)))
    return problem.observations


def write_matrix(tmp_path: Path, k: int = 31) -> np.ndarray:
    std = np.linspace(1.0, 3.0, k)
    r = np.outer(std, std) * 0.5 ** np.abs(np.subtract.outer(np.arange(k), np.arange(k)))
    rows = "\n".join(",".join(f"{v:.17g}" for v in row) for row in r)
    (tmp_path / "R.csv").write_text(f"# um^2\n{rows}\n", encoding="utf-8")
    return r


def test_exponential_correlation(tmp_path: Path) -> None:
    y = observations(tmp_path, CORRELATED)
    assert isinstance(y.noise, CorrelatedNoise)
    assert y.noise.correlation.matrix[0, 4] == pytest.approx(np.exp(-1))
    assert np.array_equal(y.std, np.full(31, 2e-6))
    assert np.array_equal(y.noise.time_std, np.full(31, 1e-5))


def test_an_error_of_the_times_as_a_share_of_the_step(tmp_path: Path) -> None:
    y = observations(tmp_path, (ERROR, f"{ERROR}, time_std: 10 % of step"))
    np.testing.assert_allclose(y.noise.time_std, 5e-4)  # readings every 5 ms
    with pytest.raises(ConfigError, match="is no share; write a number in % of step"):
        observations(tmp_path, (ERROR, f"{ERROR}, time_std: 10 % of maximum"))


def test_covariance_file(tmp_path: Path) -> None:
    r = write_matrix(tmp_path)
    y = observations(tmp_path, FROM_FILE)
    assert np.outer(y.std, y.std) * y.noise.correlation.matrix == pytest.approx(1e-12 * r, rel=1e-12)
    # one row a sample of the file: the window takes its own
    y = observations(tmp_path, FROM_FILE, ("  error:", "  window: {from: 20 ms, to: 100 ms}\n  error:"))
    assert len(y) == 17
    assert np.outer(y.std, y.std) * y.noise.correlation.matrix == pytest.approx(1e-12 * r[4:21, 4:21], rel=1e-12)
    write_matrix(tmp_path, 17)  # one row an observation of the window
    y = observations(tmp_path, FROM_FILE, ("  error:", "  window: {from: 20 ms, to: 100 ms}\n  error:"))
    assert y.std[[0, -1]] == pytest.approx([1e-6, 3e-6])


ORDER = [*range(20), *range(25, 31), *range(20, 25)]  # of a file that is not sorted
BLANK = [3, 7]


@pytest.mark.parametrize(
    ("key", "order", "first", "last"),
    [
        ("weights: " + str([1] * 29), range(31), 0, 30),
        ("window: {from: 20 ms, to: 100 ms}", range(31), 4, 20),
        ("since: 20 ms", range(31), 4, 30),
        ("outliers: leave out", range(31), 0, 30),
        ("unsorted: sort", ORDER, 0, 30),
    ],
)
def test_rows_of_a_covariance_are_those_of_the_readings_that_are_kept(
    tmp_path: Path, key: str, order: list[int], first: int, last: int
) -> None:
    odd = [15] if "outliers" in key else []
    rows = [f"{5 * i},{'' if i in BLANK else 900 if i in odd else 200 + i}" for i in range(31)]
    data = "\n".join(["t_ms,x_um", *(rows[i] for i in order), ""])
    of_file = [list(order).index(i) for i in range(first, last + 1) if i not in BLANK + odd]
    usable = [i for i in range(31) if i not in [list(order).index(b) for b in BLANK]]
    for size, where in ((31, of_file), (29, [usable.index(i) for i in of_file])):
        r = write_matrix(tmp_path, size)
        (problem,) = build(load_config(write_toy(tmp_path, FROM_FILE, ("  error:", f"  {key}\n  error:"), data=data)))
        y = problem.observations
        held = np.outer(y.std, y.std) * y.noise.correlation.matrix
        assert held == pytest.approx(1e-12 * r[np.ix_(where, where)], rel=1e-12)


def test_a_covariance_has_no_row_for_the_mean_of_several_readings(tmp_path: Path) -> None:
    data = csv_text() + "150,0\n"
    repeated = FROM_FILE, ("  error:", "  repeated: average\n  error:")
    write_matrix(tmp_path, 32)
    with pytest.raises(DataError, match=r"R\.csv: 32 rows, but 31 observations, of which some are means of readings"):
        build(load_config(write_toy(tmp_path, *repeated, data=data)))


def test_covariance_files_that_cannot_be_used(tmp_path: Path) -> None:
    write_toy(tmp_path)
    for text, message in (
        ("1,0\n0,1,0\n", r"R.csv:2: 3 numbers, but 2 in the first row"),
        ("1,0\n0,1\n1,1\n", r"R.csv: a covariance is square, but this has 3 rows of 2"),
        ("1,0.5\n0.2,1\n", r"R.csv: not symmetric: 0.5 in row 1, column 2, 0.2 across"),
        ("1,0\n0,-1\n", r"R.csv: the variances must be positive"),
        ("1,x\n0,1\n", r"R.csv:1: 'x' in column '2' is not a number"),
        ("1,0\n0,1\n", r"R.csv: 2 rows, but 31 observations"),
        ("\n".join(",".join("1" * 32) for _ in range(32)), r"R.csv: 32 rows, but 31 observations are used, of 31 usa"),
        ("", r"R.csv: a covariance is square"),
    ):
        (tmp_path / "R.csv").write_text(text, encoding="utf-8")
        with pytest.raises(DataError, match=message):
            observations(tmp_path, FROM_FILE)
    (tmp_path / "R.csv").write_text("\n".join(",".join("1" * 31) for _ in range(31)), encoding="utf-8")
    with pytest.raises(DataError, match=r"toy\.csv: the covariance of the observation errors is not positive definite"):
        observations(tmp_path, FROM_FILE)
    (tmp_path / "R.csv").unlink()
    with pytest.raises(DataError, match=r"R\.csv"):
        observations(tmp_path, FROM_FILE)


def test_a_changed_covariance_file_is_another_run(tmp_path: Path) -> None:
    write_matrix(tmp_path)
    config = load_config(write_toy(tmp_path, FROM_FILE))
    assert str(tmp_path / "R.csv") in config.resolved
    before = identity(config.resolved, config.model, {})
    assert before == identity(config.resolved, config.model, {})
    (tmp_path / "R.csv").write_text((tmp_path / "R.csv").read_text().replace("1,", "1.5,", 1), encoding="utf-8")
    assert identity(config.resolved, config.model, {}) != before


@pytest.mark.parametrize(
    ("old", "new", "fault"),
    [
        (ERROR, f"{ERROR}, correlation_time: 3", "data.error.correlation_time: 3 has no unit; write e.g. '3 s'"),
        (ERROR, f"{ERROR}, correlation_time: 0 s", "data.error.correlation_time: must be positive, not 0 s"),
        (ERROR, f"{ERROR}, corelation_time: 3 s", "data.error.corelation_time: unknown key 'corelation_time'; did"),
        (ERROR, f"{ERROR}, robust: tukey", "data.error.robust: 'tukey' is not huber"),
        (ERROR, f"{ERROR}, threshold: 2", "data.error.threshold: is that of the robust cost"),
        (ERROR, f"{ERROR}, robust: huber, threshold: -2", "data.error.threshold: must be positive, not -2"),
        (ERROR, f"{ERROR}, robust: huber, correlation_time: 3 s", "data.error.robust: not together with correlation_t"),
        (ERROR, f"{ERROR}, discrepancy: yes", "data.error.discrepancy: write estimated, or the priors"),
        (ERROR, f"{ERROR}, discrepancy: {{length: {{median: 3}}}}", "discrepancy.length.median: 3 has no unit"),
        (ERROR, f"{ERROR}, discrepancy: {{amplitude: {{median: -3 um}}}}", "amplitude.median: must be positive"),
        (ERROR, f"{ERROR}, discrepancy: {{kernel: matern}}", "data.error.discrepancy.kernel: 'matern' is not "),
        (ERROR, f"{ERROR}, discrepancy: {{grows_beyond: 3 us}}", "data.error.discrepancy.grows_beyond: '3 us': unit"),
        (ERROR, f"{ERROR}, covariance: {{path: R.csv, unit: m2}}", "data.error.covariance: not together with position"),
        (ERROR, "covariance: {path: R.csv, unit: um}", "data.error.covariance.unit: unit 'um' cannot be converted to"),
        (ERROR, "covariance: {path: R.csv}", "data.error.covariance.unit: required, but not given"),
        (ERROR, "covariance: R.csv", "data.error.covariance: expected 'key: value' lines"),
        (STATE[0], "initial_state: {w: {std: 1 m/s}}\n" + STATE[0], "initial_state.w: unknown field 'w' of the state"),
        (STATE[0], "initial_state: {c: {std: 5 %}}\n" + STATE[0], "initial_state.c: c is a parameter: give it a prior"),
        (STATE[0], "initial_state: {v: {std: 1 m}}\n" + STATE[0], "initial_state.v.std: '1 m': unit 'm' cannot be con"),
        (STATE[0], "initial_state: {v: {std: 0 m/s}}\n" + STATE[0], "initial_state.v.std: must be positive, not 0 m/s"),
        (STATE[0], "initial_state: {v: 1 m/s}\n" + STATE[0], "initial_state.v: expected 'key: value' lines"),
    ],
)  # fmt: skip
def test_mistakes_are_located(tmp_path: Path, old: str, new: str, fault: str) -> None:
    with pytest.raises(ConfigError) as error:
        load_config(write_toy(tmp_path, (old, new)))
    assert len(error.value.problems) == 1
    text = str(error.value.problems[0])
    assert fault in text
    assert text.removeprefix(f"{tmp_path}/").startswith("toy.yaml:")


def terms_of(tmp_path: Path, *replacements: tuple[str, str]):
    (problem,) = build(load_config(write_toy(tmp_path, *replacements)))
    return problem, {term.parameter.name: term for term in problem.prior.terms}


def test_discrepancy_is_scaled_to_the_data_or_as_it_is_given(tmp_path: Path) -> None:
    problem, terms = terms_of(tmp_path, (ERROR, f"{ERROR}, discrepancy: estimated"))
    y = problem.observations
    amplitude, length = terms["discrepancy_amplitude"], terms["discrepancy_length"]
    assert (amplitude.parameter.unit, length.parameter.unit) == ("m", "s")
    assert np.exp(amplitude.mean) == pytest.approx(0.005 * y.values.max())
    assert np.exp(length.mean) == pytest.approx(0.1 * (y.times[-1] - y.times[0]))
    assert (amplitude.std, length.std) == (1.5, 0.7)
    assert y.noise.kernel.smoothness == 0.5
    assert not y.noise.kernel.grows
    given = (
        "{amplitude: {median: 3 um}, length: {median: 4 ms, log_std: 0.3}, kernel: matern-3/2, grows_beyond: 2 mm/s}"
    )
    problem, terms = terms_of(tmp_path, (ERROR, f"{ERROR}, time_std: 10 us, robust: huber, discrepancy: {given}"))
    noise = problem.observations.noise
    assert np.exp([terms["discrepancy_amplitude"].mean, terms["discrepancy_length"].mean]) == pytest.approx(
        [3e-6, 4e-3]
    )
    assert terms["discrepancy_length"].std == 0.3
    assert (noise.kernel.smoothness, noise.kernel.grows_beyond, noise.threshold) == (1.5, 2e-3, 1.345)


@pytest.mark.slow
def test_a_discrepancy_from_yaml_to_the_page(tmp_path: Path) -> None:
    """A slow wave that the model lacks: posterior variables, what is kept, and what the page says."""
    lines = csv_text().splitlines()
    for i, line in enumerate(lines[2:], 2):
        time, position = map(float, line.split(","))
        lines[i] = f"{time},{position + 8 * np.sin(time / 8)}"
    config = write_toy(
        tmp_path, (ERROR, f"{ERROR}, discrepancy: {{grows_beyond: 10 m/s}}"), ("members: 8", "members: 24"),
        data="\n".join(lines) + "\n",
    )  # fmt: skip
    outcome = CliRunner().invoke(main, ["run", str(config), "--out", str(tmp_path / "run")])
    assert outcome.exit_code == 0, outcome.output
    result = load_result(tmp_path / "run" / "posterior.nc")
    units = {name: v.attrs["units"] for name, v in result.posterior.data_vars.items()}
    assert units["discrepancy_amplitude"] == "m"
    assert units["discrepancy_length"] == "s"
    stats = result.sample_stats
    shares = [stats[f"variance_from_{source}"].values for source in ("errors", "discrepancy", "prior")]
    assert np.sum(shares, axis=0) == pytest.approx(np.ones(len(units)))
    assert 0.5 < stats.attrs["discrepancy_share"] <= 1
    y = load_config(config)
    (problem,) = build(y)
    assert result.observations().noise.attributes() == problem.observations.noise.attributes()
    page = (tmp_path / "run" / "report.html").read_text(encoding="utf-8")
    assert "What the error bars are made of" in page
    assert 'id="d0-residuals"' in page
    assert "+ discrepancy" in CliRunner().invoke(main, ["validate", str(config)]).output


def test_run_with_everything(tmp_path: Path) -> None:
    """An outlier, a noise scale and an initial velocity: what the file holds and what the run says."""
    lines = csv_text().splitlines()
    assert lines[12].startswith("50,")
    lines[12] = "50,500"
    config = write_toy(
        tmp_path,
        (ERROR, "position_std: 2 um, robust: huber"),
        ("  c: 0.02 N s/m\n", "  c: 0.02 N s/m\n  sigma: {prior: lognormal, median: 1, log_std: 0.5}\n"),
        ("mean: maximum", "mean: 100 um"),
        STATE,
        ("members: 8", "members: 24"),
        data="\n".join(lines) + "\n",
    )
    outcome = CliRunner().invoke(main, ["run", str(config), "--out", str(tmp_path / "run"), "--no-report"])
    assert outcome.exit_code == 0, outcome.output
    result = load_result(tmp_path / "run" / "posterior.nc")
    assert {name: v.attrs["units"] for name, v in result.posterior.data_vars.items()} == {
        "A": "m", "k": "N/m", "sigma": "1", "initial_v": "m/s", "initial_x": "1",
    }  # fmt: skip
    observed = result.observed_data
    assert int(np.argmin(observed["position_huber_weight"].values)) == 10
    assert observed["position_huber_weight"].values[10] < 0.1
    assert observed.attrs["huber_threshold"] == 1.345
    assert any(re.search(r"\b0\.05 s \(\d+ std off, weight 0\.0", words) for words in result.warnings)
    rows = {row.name: row for row in result.rows}
    assert abs(rows["k"].mean - 2.0) < 4 * rows["k"].std
    assert abs(rows["initial_v"].mean) < 4 * rows["initial_v"].std < 0.2
    assert "robust beyond 1.345 std" in CliRunner().invoke(main, ["validate", str(config)]).output


def test_a_result_keeps_the_correlation(tmp_path: Path) -> None:
    config = write_toy(tmp_path, CORRELATED)
    outcome = CliRunner().invoke(main, ["run", str(config), "--out", str(tmp_path / "run"), "--no-report"])
    assert outcome.exit_code == 0, outcome.output
    result = load_result(tmp_path / "run" / "posterior.nc")
    decay = result.observed_data["position_decay_time"]
    assert decay.dims == ("time",)
    assert decay.values[4] - decay.values[0] == pytest.approx(1)
    assert result.observations().noise.correlation.matrix[0, 4] == pytest.approx(np.exp(-1))


def test_only_the_initial_state_may_be_estimated(tmp_path: Path) -> None:
    config = load_config(
        write_toy(
            tmp_path,
            ("{prior: normal, mean: maximum, std: 1 %}", "100 um"),
            ("{prior: lognormal, median: 3 N/m, log_std: 0.3}", "2 N/m"),
            STATE,
        )
    )
    (problem,) = build(config)
    assert problem.prior.names == ("initial_v", "initial_x")
    assert problem.prior.std == pytest.approx([0.2, 0.05])
    assert [(p.field, p.relative) for p in problem.perturbations] == [("v", False), ("x", True)]
