"""Covariances and ensembles beside a control file of PEST: the formats, and the posterior against its closed form."""

from __future__ import annotations

import struct

import numpy as np
import pytest

import en4dvar
from en4dvar.model.programs.control import from_pest
from en4dvar.model.programs.control_file import read_matrix

NAMES = ("k:1", "h", "other")  # the third is no parameter
PRIOR = np.array([[0.25, 0.3, 0.0], [0.3, 1.0, 0.1], [0.0, 0.1, 2.0]])
ERRORS = np.array([[0.04, -0.03], [-0.03, 0.09]])


def padded(names, width):
    return b"".join(name.encode().ljust(width) for name in names)


def old_binary(rows, columns, values):
    """PEST's: counted from 1 down the columns, names of 12 and 20 characters."""
    at = [(i, j) for j in range(len(columns)) for i in range(len(rows)) if values[i, j]]
    entries = b"".join(struct.pack("<id", 1 + i + j * len(rows), values[i, j]) for i, j in at)
    return struct.pack("<3i", -len(columns), -len(rows), len(at)) + entries + padded(columns, 12) + padded(rows, 20)


def long_binary(rows, columns, values):
    at = np.argwhere(values)
    entries = b"".join(struct.pack("<iid", i, j, values[i, j]) for i, j in at)
    return struct.pack("<3i", len(columns), len(rows), len(at)) + entries + padded(columns, 200) + padded(rows, 200)


def dense_binary(rows, columns, values):
    head = struct.pack("<3i", 0, -len(columns), -len(columns))
    head += struct.pack(f"<{len(columns)}i", *map(len, columns)) + "".join(columns).encode()
    lines = (
        struct.pack("<i", len(r)) + r.encode() + struct.pack(f"<{len(v)}d", *v)
        for r, v in zip(rows, values, strict=True)
    )
    return head + b"".join(lines)


def text(rows, columns, values):
    numbers = "\n".join(" ".join(f"{v!r}".replace("e", "D") for v in row) for row in values.tolist())
    names = "\n".join(["* row names", *rows, "* column names", *columns])
    return f" {len(rows)} {len(columns)} 2\n{numbers}\n{names}\n".encode()


def one_list(rows, columns, values):
    return text(rows, columns, values).split(b"* column")[0].replace(b" 2\n", b" 1\n").replace(b"row names", b"names")


def table(rows, columns, values):
    lines = [",".join(map(repr, row)) for row in values.tolist()]
    return "\n".join([",".join(["", *columns]), *(f"{r},{v}" for r, v in zip(rows, lines, strict=True))]).encode()


FORMATS = {
    "old.jcb": old_binary, "long.jco": long_binary, "dense.bin": dense_binary, "text.cov": text, "one.mat": one_list,
    "table.csv": table,
}  # fmt: skip


@pytest.mark.parametrize("name", FORMATS)
def test_a_matrix_is_what_was_written(tmp_path, name):
    path = tmp_path / name
    path.write_bytes(FORMATS[name](NAMES, [n.upper() for n in NAMES], PRIOR))
    found = read_matrix(path)
    assert found.columns == found.rows == NAMES
    np.testing.assert_array_equal(found.values, PRIOR)
    np.testing.assert_array_equal(found.covariance(["h", "k:1"]), [[1.0, 0.3], [0.3, 0.25]])


def test_an_uncertainty_file_joins_deviations_and_matrices(tmp_path):
    (tmp_path / "two.mat").write_bytes(text(NAMES[:2], NAMES[:2], PRIOR[:2, :2]))
    path = tmp_path / "all.unc"
    path.write_text(
        "START STANDARD_DEVIATION\n std_multiplier 2.0\n c 0.5 # a comment\nEND STANDARD_DEVIATION\n"
        'START COVARIANCE_MATRIX\n file "two.mat"\n variance_multiplier 4\nEND COVARIANCE_MATRIX\n'
    )
    found = read_matrix(path)
    assert found.rows == ("c", "k:1", "h")
    np.testing.assert_allclose(found.values, [[1, 0, 0], [0, 1, 1.2], [0, 1.2, 4]])


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.jcb", old_binary(NAMES, NAMES, PRIOR)[:30], "is no matrix of PEST"),
        ("a.jcb", struct.pack("<3i", 2**30, 2**30, 0), "is no matrix of PEST: 1073741824 rows"),
        ("a.cov", b"3 3 2\n1 2 3\n* row names\n", "is no matrix of PEST"),
        ("a.cov", b"1 1 1\nnan\n* row and column names\na\n", "holds something else than finite numbers"),
        ("a.csv", b",a,A\nr,1,2\n", "a column occurs twice"),
        ("a.unc", b"START PEST_CONTROL_FILE\n file a.pst\nEND PEST_CONTROL_FILE\n", "block pest_control_file"),
    ],
)
def test_what_is_no_matrix_is_told(tmp_path, name, content, words):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(en4dvar.ConfigError) as caught:
        read_matrix(tmp_path / name)
    assert str(tmp_path / name) in str(caught.value)
    assert words in str(caught.value)


CONTROL = """pcf
* control data
restart estimation
* parameter data
k:1 none relative 1.0 -90 90 pg 1.0 0.0 1
h none relative 2.0 -90 90 pg 1.0 0.0 1
* observation data
o1 1.4 5.0 og
o2 1.1 4.0 og
unused 0 0 og
* model command line
cat in.dat > out.dat
* model input/output
in.tpl in.dat
out.ins out.dat
++ OPTIONS
"""


@pytest.fixture
def control(tmp_path):
    def written(options, **files):
        for name, content in files.items():
            (tmp_path / name.replace("__", ".")).write_bytes(content)
        (tmp_path / "in.tpl").write_text("ptf ~\n~   k:1                ~\n~  h                   ~\n")
        (tmp_path / "out.ins").write_text("pif @\nl1 !o1!\nl1 !o2!\n")
        (tmp_path / "a.pst").write_text(CONTROL.replace("OPTIONS", options))
        return tmp_path / "a.pst"

    return written


def checked(found, mean, prior, errors):
    """The posterior of the identity as model."""
    gain = prior @ np.linalg.inv(prior + errors)
    middle, covariance = mean + gain @ (np.array([1.4, 1.1]) - mean), prior - gain @ prior
    result = en4dvar.estimate(**found, progress=False, assimilation={"members": 24, "refine": "none", "what_if": False})
    draws = np.column_stack([result.posterior[name].values.ravel() for name in ("k_1", "h")])
    np.testing.assert_allclose(draws.mean(axis=0), middle, atol=2e-3 * np.sqrt(np.diag(covariance)).min())
    np.testing.assert_allclose(np.cov(draws.T), covariance, rtol=5e-3, atol=1e-4)


def test_covariances_of_parameters_and_observations_against_the_closed_form(control):
    errors = text(("o2", "o1", "x"), ("o2", "o1", "x"), np.pad(ERRORS[::-1, ::-1], (0, 1)) + np.diag([0, 0, 1.0]))
    path = control(
        "parcov(prior.jcb) obscov(errors.cov)", prior__jcb=old_binary(NAMES, NAMES, PRIOR), errors__cov=errors
    )
    found = from_pest(path)
    np.testing.assert_array_equal(found["error"]["covariance"], ERRORS)
    checked(found, np.array([1.0, 2.0]), PRIOR[:2, :2], ERRORS)


def test_a_prior_ensemble_is_the_prior(control):
    members = np.random.default_rng(3).multivariate_normal([0.5, 1.5, 0.0], PRIOR, 24)
    rows = [str(i) for i in range(24)]
    found = from_pest(control("ies_par_en(par.csv)", par__csv=table(rows, NAMES, members)))
    checked(found, members[:, :2].mean(axis=0), np.cov(members[:, :2].T), np.diag([0.04, 0.0625]))


def test_a_covariance_of_logarithms_is_that_of_decadic_ones(control):
    path = control("parcov(prior.cov)", prior__cov=text(NAMES, NAMES, PRIOR))
    path.write_text(path.read_text().replace("k:1 none relative 1.0 -90", "k:1 log factor 1.0 0.01"))
    found = from_pest(path)
    assert found["priors"]["k_1"]["log_std"] == pytest.approx(0.5 * np.log(10))
    assert found["priors"]["h"]["std"] == pytest.approx(1.0)
    (block,) = found["prior_correlation"]
    assert block["between"] == ["k_1", "h"]
    assert block["matrix"][0][1] == pytest.approx(0.6)


def test_draws_of_errors_are_held_against_the_weights(control):
    rng = np.random.default_rng(1)
    draws = np.array([1.4, 1.1]) + rng.standard_normal((200, 2)) * [0.2, 0.25]
    rows = [str(i) for i in range(200)]
    path = control("ies_obs_en(obs.jcb)", obs__jcb=long_binary(rows, ("o1", "o2"), draws))
    np.testing.assert_allclose(from_pest(path)["error"], [0.2, 0.25])
    for wrong in (draws + np.array([0.0, 0.3]), draws * [3.0, 1.0] - [2.8, 0.0]):
        (path.parent / "obs.jcb").write_bytes(long_binary(rows, ("o1", "o2"), wrong))
        with pytest.raises(en4dvar.ConfigError, match="errors are drawn from the weights here"):
            from_pest(path)


@pytest.mark.parametrize(
    ("options", "files", "words"),
    [
        ("parcov(none.cov)", {}, "a.pst: option parcov: "),
        ("parcov(p.cov)", {"p__cov": text(NAMES[1:], NAMES[1:], PRIOR[1:, 1:])}, "p.cov: lacks k:1"),
        ("parcov(p.cov)", {"p__cov": text(NAMES, NAMES, PRIOR - np.eye(3))}, "p.cov: is no covariance of k:1"),
        ("ies_par_en(p.csv)", {"p__csv": table("ab", ("k:1",), np.ones((2, 1)))}, "p.csv: lacks h"),
    ],
)
def test_files_that_do_not_suit_are_named(control, options, files, words):
    with pytest.raises(en4dvar.ConfigError) as caught:
        from_pest(control(options, **files))
    assert words in str(caught.value)


def test_correlated_errors_and_inequalities_do_not_go_together(control):
    path = control("obscov(e.cov)", e__cov=text(("o1", "o2"), ("o1", "o2"), ERRORS))
    path.write_text(path.read_text().replace("o2 1.1 4.0 og", "o2 1.1 4.0 less_og"))
    with pytest.raises(en4dvar.ConfigError, match="do not go together with groups of inequalities"):
        from_pest(path)
