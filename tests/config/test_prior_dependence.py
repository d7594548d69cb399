"""Correlations between priors and priors from an ensemble, from YAML to the posterior; bad input is told in place."""

from pathlib import Path

import netCDF4
import numpy as np
import pytest
from toy_config import write_toy

from en4dvar.assembly.build import build
from en4dvar.config import load_config
from en4dvar.inputs.members import netcdf_members
from en4dvar.plumbing.errors import ConfigError
from en4dvar.runs.runner import run

FREE_C = ("  c: 0.02 N s/m\n", "  c: {prior: lognormal, median: 0.02 N s/m, log_std: 0.5}\n")
A_MEMBERS = ("A: {prior: normal, mean: maximum, std: 1 %}", "A: {prior: ensemble}")
K_MEMBERS = ("k: {prior: lognormal, median: 3 N/m, log_std: 0.3}", "k: {prior: ensemble}")


def add(text: str) -> tuple[str, str]:
    return "assimilation:\n", f"{text}\nassimilation:\n"


def prior_of(path: Path):
    (problem,) = build(load_config(path))
    return problem.prior


def members(count: int = 40) -> dict[str, np.ndarray]:
    draws = np.random.default_rng(3).standard_normal((2, count))
    return {"A": 1e-4 * (1 + 0.02 * draws[0]), "k": 2.0 * np.exp(0.2 * (0.8 * draws[0] + 0.6 * draws[1]))}


def write_netcdf(path: Path, values, dims=("draw",), units=("m", "N/m"), group="") -> None:
    with netCDF4.Dataset(path, "w") as file:
        where = file.createGroup(group) if group else file
        for dim, size in zip(dims, values["A"].shape, strict=True):
            where.createDimension(dim, size)
        for (name, numbers), unit in zip(values.items(), units, strict=True):
            variable = where.createVariable(name, "f8", dims)
            variable[:] = numbers
            if unit:
                variable.units = unit


def test_pairs_join_to_one_matrix(tmp_path):
    pairs = "prior_correlation:\n  - {between: [k, A], correlation: 0.6}\n  - {between: [A, c], correlation: -0.3}"
    (block,) = prior_of(write_toy(tmp_path, FREE_C, add(pairs))).blocks
    assert block.names == ("k", "A", "c")
    assert block.matrix == pytest.approx(np.array([[1, 0.6, 0], [0.6, 1, -0.3], [0, -0.3, 1]]))


@pytest.mark.parametrize("how", ["matrix: [[1, 0.6], [0.6, 1]]", "file: corr.csv"])
def test_a_matrix_inline_or_in_a_file_is_written_out_and_loads_again(tmp_path, how):
    (tmp_path / "corr.csv").write_text("1,0.6\n0.6,1\n")
    config = load_config(write_toy(tmp_path, add(f"prior_correlation:\n  - {{between: [k, A], {how}}}")))
    again = tmp_path / "elsewhere" / "again.yaml"
    again.parent.mkdir()
    again.write_text(config.resolved)
    assert load_config(again).dependence == config.dependence
    assert config.dependence[0].matrix[0, 1] == 0.6


@pytest.mark.parametrize(
    ("kernel", "expected"), [("exponential", np.exp(-2)), ("gaussian", np.exp(-2)), ("matern-3/2", None)]
)
def test_a_function_of_distance(tmp_path, kernel, expected):
    text = f"prior_correlation:\n  - {{between: [k, A, c], kernel: {kernel}, at: [0, 1, 4], length: 2}}"
    (block,) = prior_of(write_toy(tmp_path, FREE_C, add(text))).blocks
    r = np.sqrt(3) * 2
    assert block.matrix[0, 2] == pytest.approx((1 + r) * np.exp(-r) if expected is None else expected, rel=1e-7)


def test_an_ensemble_of_as_many_members_is_the_prior_ensemble(tmp_path):
    values = members(8)
    write_netcdf(tmp_path / "prior.nc", values)
    path = write_toy(tmp_path, A_MEMBERS, K_MEMBERS, add("prior: {ensemble: prior.nc}"))
    prior = prior_of(path)
    drawn = prior.to_physical(prior.sample(8, 1))
    assert drawn[:, 0] == pytest.approx(values["A"], rel=1e-10)
    assert drawn[:, 1] == pytest.approx(values["k"], rel=1e-10)
    more = prior.sample(30, 1)
    x = np.stack([values["A"], np.log(values["k"])])
    assert np.cov(more.T) == pytest.approx(np.cov(x), rel=1e-10)
    assert more.mean(axis=0) == pytest.approx(x.mean(axis=1), rel=1e-10)


def test_the_posterior_of_a_run_is_the_prior_of_the_next(tmp_path):
    overrides = {"output.directory": str(tmp_path / "first"), "output.report": False}
    first = run(write_toy(tmp_path, ("members: 8", "members: 20")), overrides=overrides)
    (tmp_path / "next").mkdir()
    path = write_toy(tmp_path / "next", A_MEMBERS, K_MEMBERS, add("prior: {ensemble: ../first/posterior.nc}"))
    posterior = np.stack([first.posterior[name].values.ravel() for name in ("A", "k")], axis=1)
    prior = prior_of(path)
    assert prior.mean == pytest.approx([posterior[:, 0].mean(), np.log(posterior[:, 1]).mean()], rel=1e-10)
    x = np.stack([posterior[:, 0], np.log(posterior[:, 1])])
    assert np.cov(prior.sample(12, 1).T) == pytest.approx(np.cov(x), rel=1e-9)


@pytest.mark.parametrize(("kind", "taken"), [("posterior", "k"), ("without_hyperprior", "k_next")])
def test_only_of_a_population_the_next_data_set_is_taken(tmp_path, kind, taken):
    """A parameter of a run may be called ``k_next``."""
    drawn = {"A": np.arange(9.0), "k": 1.0 + np.arange(9.0), "k_next": 50.0 + np.arange(9.0)}
    write_netcdf(tmp_path / "other.nc", drawn, units=("m", "N/m", "N/m"), group="posterior")
    with netCDF4.Dataset(tmp_path / "other.nc", "a") as file:
        file.createGroup(kind)
    (held,) = netcdf_members(tmp_path / "other.nc", ["A", "k"])
    np.testing.assert_array_equal(held["k"][0], drawn[taken])


def test_csv_with_stated_units(tmp_path):
    values = members()
    table = "A,k\n" + "".join(f"{1e6 * float(a)!r},{float(k)!r}\n" for a, k in zip(*values.values(), strict=True))
    (tmp_path / "prior.csv").write_text(table)
    stated = (A_MEMBERS[0], "A: {prior: ensemble, unit: um}"), (K_MEMBERS[0], "k: {prior: ensemble, unit: N/m}")
    prior = prior_of(write_toy(tmp_path, *stated, add("prior: {ensemble: prior.csv}")))
    assert prior.mean == pytest.approx([values["A"].mean(), np.log(values["k"]).mean()], rel=1e-12)


def spoil(values, name, index, number):
    values[name][index] = number
    return values


FILES = {
    "few.nc": (lambda: members(3), {}),
    "nan.nc": (lambda: spoil(members(), "k", 3, np.nan), {}),
    "negative.nc": (lambda: spoil(members(), "k", 3, -1.0), {}),
    "zero.nc": (lambda: spoil(members(), "k", 3, 0.0), {}),
    "same.nc": (lambda: {"A": np.full(40, 1e-4), "k": members()["k"]}, {}),
    "dependent.nc": (lambda: {"A": members()["A"], "k": np.exp(1e4 * members()["A"])}, {}),
    "unitless.nc": (members, {"units": ("m", "")}),
    "length.nc": (members, {"units": ("m", "m")}),
    "sets.nc": (lambda: {k: v.reshape(2, 20) for k, v in members().items()}, {"dims": ("dataset", "draw")}),
}


@pytest.mark.parametrize(
    ("file", "line", "words"),
    [
        ("few.nc", 16, "3 members are too few for 2 parameters; at least 4"),
        ("nan.nc", 16, "k has 1 members that are not finite numbers"),
        ("negative.nc", 14, "1 of 40 members lie outside of [0, inf] N/m, e.g. -1"),
        ("zero.nc", 14, "k: values must lie strictly between 0 and inf, as map: lognormal has it"),
        ("same.nc", 13, "the standard deviation"),
        ("dependent.nc", 16, "the matrix is not positive definite"),
        ("unitless.nc", 16, "k has no unit there; netCDF has it as attribute units; a prior may say it, 'k: {"),
        ("length.nc", 16, "unit 'm' cannot be converted to 'N/m'"),
        ("sets.nc", 16, "A lies along dataset, draw; members must lie along one of chain, draw"),
        ("none.nc", 16, "none.nc: no such file"),
        ("text.nc", 16, "cannot be read as netCDF"),
    ],
)
def test_a_bad_ensemble_is_told_in_place(tmp_path, file, line, words):
    (tmp_path / "text.nc").write_text("A,k\n")
    if file in FILES:
        make, options = FILES[file]
        write_netcdf(tmp_path / file, make(), **options)
    assert one_fault(tmp_path, (A_MEMBERS, K_MEMBERS, add(f"prior: {{ensemble: {file}}}")), words) == line


@pytest.mark.parametrize(
    ("text", "line", "words"),
    [
        ("{between: [k, A], correlation: 1.5}", 17, "should be less than 1"),
        ("{between: [k], correlation: 0.5}", 17, "give at least 2"),
        ("{between: [k, A]}", 17, "give one of correlation, matrix, file, kernel"),
        ("{between: [k, A], correlation: 0.5, matrix: [[1, 0], [0, 1]]}", 17, "give one of correlation, matrix"),
        ("{between: [k, B], correlation: 0.5}", 17, "'B' is not a parameter with a prior; known: A, k"),
        ("{between: [k, c], correlation: 0.5}", 17, "'c' is not a parameter with a prior; known: A, k"),
        ("{between: [k, A], matrix: [[1, 2], [2, 1]]}", 17, "not positive definite"),
        ("{between: [k, A], matrix: [[1, 2], [2]]}", 17, "rows of the matrix have different lengths"),
        ("{between: [k, A], file: none.csv}", 17, "none.csv: no such file"),
        ("{between: [k, A], kernel: exponential, length: 1}", 17, "a kernel needs both"),
        ("{between: [k, A], kernel: exponential, at: [0], length: 1}", 17, "give 2 places"),
        ("{between: [k, A], kernel: expo, at: [0, 1], length: 1}", 17, "'expo' is not one of exponential"),
        ("{between: [k, A], correlation: 0.5}\n  - {between: [A, k], correlation: 0.4}", 17, "is given twice"),
    ],
)
def test_a_bad_correlation_is_told_in_place(tmp_path, text, line, words):
    assert one_fault(tmp_path, (add(f"prior_correlation:\n  - {text}"),), words) == line


@pytest.mark.parametrize(
    ("changes", "line", "words"),
    [
        ((A_MEMBERS,), 13, "no ensemble is given; write 'prior: {ensemble: FILE}'"),
        ((add("prior: {ensemble: prior.nc}"),), 16, "no parameter takes its prior from it"),
        (((A_MEMBERS[0], "A: {prior: ensemble, mean: 1 um}"),), 13, "an ensemble prior takes map and unit"),
        (((A_MEMBERS[0], "A: {prior: normal, map: logit}"),), 13, "may have lower, upper or both; given: map"),
        (
            ((FREE_C[0], "  sigma: {prior: lognormal, median: 1, log_std: 0.5}\n"),
             add("prior_correlation:\n  - {between: [sigma, A], correlation: 0.5}")),
            17, "sigma cannot be correlated: it is the scale of the errors",
        ),
    ],
)  # fmt: skip
def test_what_does_not_go_together_is_told_in_place(tmp_path, changes, line, words):
    assert one_fault(tmp_path, changes, words) == line


def one_fault(folder: Path, changes, words: str) -> int | None:
    with pytest.raises(ConfigError) as error:
        load_config(write_toy(folder, *changes))
    (told,) = error.value.problems
    assert words in told.message
    return told.line
