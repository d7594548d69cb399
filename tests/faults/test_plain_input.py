"""Plain input that once ended in a traceback, in a wall of text or in a program of somebody else's."""

from __future__ import annotations

import csv
import fcntl
import io
import os
import re
import shutil
import warnings
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import xarray as xr
from click.testing import CliRunner, Result
from rows import row
from toy_config import csv_text, write_toy
from toys import Linear, make_problem

from en4dvar.cli import main
from en4dvar.commands.common import printable
from en4dvar.estimation.assimilate import assimilate
from en4dvar.estimation.summary import summary_rows
from en4dvar.executor import run_chunk
from en4dvar.model.forward import Failure
from en4dvar.model.state import Array, Parameter
from en4dvar.plumbing.errors import ConfigError, OutputError
from en4dvar.plumbing.tables import csv_text as table_text
from en4dvar.priors.prior import PriorTerm
from en4dvar.report import write_pages
from en4dvar.report.export import latex_symbol
from en4dvar.report.result import Result as Posterior
from en4dvar.report.result import load_result
from en4dvar.results.netcdf import seal_file
from en4dvar.runs.lock import LOCK, locked
from en4dvar.schemes.settings import AssimilationSettings

MODEL = "from toy_models import Oscillator\nclass Own(Oscillator):\n    pass\n"


def call(*arguments: str | Path) -> Result:
    return CliRunner().invoke(main, [str(a) for a in arguments])


def refused(path: Path, command: str = "validate") -> str:
    """The message; the exit code is that of a mistake in the input, and nothing escapes."""
    done = call(command, path)
    assert isinstance(done.exception, SystemExit), done.exception
    assert done.exit_code == 2, done.output
    return done.stderr


K, A = "{prior: lognormal, median: 3 N/m, log_std: 0.3}", "{prior: normal, mean: maximum, std: 1 %}"
NUMBERS = {
    "prior mean 1e-200": (K, "{prior: lognormal, mean: 1e-200 N/m, std: 1 N/m}", "parameters.k"),
    "prior std 1e300": (K, "{prior: lognormal, mean: 1 N/m, std: 1e300 N/m}", "parameters.k"),
    "normal std 1e200": (A, "{prior: normal, mean: 1 um, std: 1e200 m}", "parameters.A"),
    "normal mean 1e200": (A, "{prior: normal, mean: 1e200 m, std: 1 %}", "parameters.A"),
    "normal std 1e-200": (A, "{prior: normal, mean: 1 m, std: 1e-200 m}", "parameters.A"),
    "log_std 1e308": (K, "{prior: lognormal, median: 3 N/m, log_std: 1e308}", "parameters.k"),
    "log_std 1e-20": (K, "{prior: lognormal, median: 3 N/m, log_std: 1e-20}", "parameters.k"),
    "logit_std 1e300": (
        K, "{prior: logit, lower: 1 N/m, upper: 5 N/m, median: 3 N/m, logit_std: 1e300}", "parameters.k"
    ),
    "seed 2^63": ("seed: 3", "seed: 9223372036854775808", "seed"),
    "seed 1e300": ("seed: 3", "seed: 1e300", "seed"),
    "400 digits": ("mass: 2 g", f"mass: {'9' * 400} g", "model.mass"),
    "past the largest": ("mass: 2 g", f"mass: {'9' * 90}e300 g", "model.mass"),
    "std 1e-200": ("2 um", "1e-200 um", "data"),
    "endless times": ("name: toy", "name: toy\nsimulate: {times: {to: 1 s, step: 1e-320 ms}}", "simulate.times"),
}  # fmt: skip


@pytest.mark.parametrize("name", NUMBERS)
@pytest.mark.fault("odd-number")
def test_numbers_that_cannot_be_computed_with(tmp_path: Path, name: str) -> None:
    old, new, key = NUMBERS[name]
    path = write_toy(tmp_path, (old, new))
    message = refused(path)
    assert row("odd-number").told(message)
    assert re.search(rf"^{re.escape(str(path))}:\d+:\d+: {re.escape(key)}", message), message
    assert len(message) < 600


def test_the_largest_seed_and_priors_that_can_be_told_from_rounding(tmp_path: Path) -> None:
    path = write_toy(tmp_path, ("seed: 3", "seed: 9223372036854775807"), ("log_std: 0.3", "log_std: 1e-9"))
    done = call("run", path, "--no-report", "--out", tmp_path / "run")
    assert done.exit_code == 0, done.output
    for std, mean in ((1e-13, 1.0), (1e160, 1.0), (1e-170, 0.0), (1.0, 1e160)):
        with pytest.raises(ConfigError, match=r"too small|too large"):
            PriorTerm.normal(Parameter("x", "1"), mean, std)


@pytest.mark.fault("odd-number")
def test_readings_of_1e300_have_a_reason(tmp_path: Path) -> None:
    """They used to be accepted, and the run ended with an empty list of reasons."""
    path = write_toy(tmp_path, data=re.sub(r"(?m)^([\d.]+,-?[\d.]+)$", r"\1e300", csv_text()))
    for command in ("validate", "run"):
        message = refused(path, command)
        assert row("odd-number").told(message) or command == "run"  # which names the file of the data alone
        assert "among the observations; is the unit right?" in message


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("members: 8", f"members: {'a' * 50_000}"),
        ("{position_std: 2 um}", f"[[{'b' * 50_000}]]"),
        ("path: toy.csv", f"path: {'c' * 50_000}"),
        ("unit: ms", f"unit: {'d' * 50_000}"),
        ("log_std: 0.3", f"{'e' * 50_000}: 0.3"),
        ("toy_models:Oscillator", "f" * 50_000),
        ("2 um", "9" * 50_000),
        ("name: x_um", f"name: {'g' * 50_000}"),
    ],
)
@pytest.mark.fault("long-value")
def test_a_long_value_is_not_repeated(tmp_path: Path, old: str, new: str) -> None:
    message = refused(write_toy(tmp_path, (old, new)))
    assert row("long-value").told(message)
    assert max(map(len, message.splitlines())) < 2500


@pytest.mark.fault("no-home")
def test_the_home_of_nobody(tmp_path: Path) -> None:
    for old, new in (
        ("toy.csv", "~nosuchuser/x.csv"),
        ("toy_models:Oscillator", "~nosuchuser/x.py:Y"),
        ("{position_std: 2 um}", "{covariance: {path: ~nosuchuser/x.csv, unit: um^2}}"),
    ):
        message = refused(write_toy(tmp_path, (old, new)))
        assert row("no-home").told(message)
        assert re.search(r"toy.yaml:\d+:\d+: (data|model)\.", message), "where"


@pytest.mark.parametrize("name", ["./own.py:Own", "../{folder}/own.py:Own", "own.py:Own", "{path}/own.py:Own"])
def test_a_model_in_a_file_beside_the_configuration(tmp_path: Path, name: str) -> None:
    """As laws do: relative to the configuration, in other processes, and for rerun from anywhere."""
    (tmp_path / "own.py").write_text(MODEL, encoding="utf-8")
    name = name.format(folder=tmp_path.name, path=tmp_path)
    path = write_toy(tmp_path, ("toy_models:Oscillator", name))
    done = call("validate", path)
    assert done.exit_code == 0, done.output


@pytest.mark.slow
def test_a_model_in_a_file_goes_to_other_processes_and_is_run_again(tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text(MODEL, encoding="utf-8")
    path = write_toy(tmp_path, ("toy_models:Oscillator", "./own.py:Own"))
    options = ["--no-report", "--out", tmp_path / "run", "--set", "execution.executor=processes"]
    done = call("run", path, *options, "--set", "execution.workers=2")
    assert done.exit_code == 0, done.output
    assert "the same bits" in call("rerun", tmp_path / "run", "--trust").output


@pytest.mark.fault("own-code")
def test_a_file_that_raises_as_it_is_imported(tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text("x = 1\nraise RuntimeError('not today')\n", encoding="utf-8")
    message = refused(write_toy(tmp_path, ("toy_models:Oscillator", "./own.py:Own")))
    assert row("own-code").told(message)
    assert f"{tmp_path / 'own.py'}:2: " in message
    (tmp_path / "own.py").write_text("def f(:\n", encoding="utf-8")
    assert "own.py:1: SyntaxError" in refused(write_toy(tmp_path, ("toy_models:Oscillator", "./own.py:Own")))
    (tmp_path / "own.py").write_text(MODEL, encoding="utf-8")
    message = refused(write_toy(tmp_path, ("toy_models:Oscillator", "./own.py:Owm")))
    assert "no class 'Owm'; did you mean 'Own'?" in message
    for name, reason in (
        ("./gone.py:Own", "no such file"),
        ("..:Own", "cannot be loaded"),
        ("/dev:X", "is a directory"),
    ):
        assert reason in refused(write_toy(tmp_path, ("toy_models:Oscillator", name)))


def test_a_package_that_raises_as_it_is_imported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "raises_at_import.py").write_text("raise RuntimeError('not today')\n", encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    message = refused(write_toy(tmp_path, ("toy_models:Oscillator", "raises_at_import:Own")))
    assert "RuntimeError: not today" in message


SYMBOLS = {
    r"$\\frac{a$": r"\frac",
    "$x": "left over",
    r"$\\nope$": r"\nope",
    r"a\tb": "not printed",
    "$a_b_c$": "subscript",
}


@pytest.mark.parametrize("symbol", SYMBOLS)
@pytest.mark.fault("symbol")
def test_a_symbol_that_no_figure_can_hold_is_found_before_the_work(tmp_path: Path, symbol: str) -> None:
    for what in ("symbol", "label"):
        text = MODEL.replace(
            "pass", f'parameters = tuple(replace(p, {what}="{symbol}") for p in Oscillator.parameters)'
        )
        (tmp_path / "own.py").write_text(f"from dataclasses import replace\n{text}", encoding="utf-8")
        message = refused(write_toy(tmp_path, ("toy_models:Oscillator", "./own.py:Own")))
        assert SYMBOLS[symbol] in message
        assert row("symbol").told(message) or what == "label"


@pytest.mark.parametrize("number", ["99999999999999999999", "²", "0", "-1"])
@pytest.mark.fault("lock-number")
def test_a_lock_of_a_process_that_cannot_be(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: str) -> None:
    monkeypatch.setattr("en4dvar.runs.lock.PATIENCE", 0.1)
    (tmp_path / LOCK).write_text(f"\0process {number} on {os.uname().nodename}\n", encoding="utf-8")
    with (tmp_path / LOCK).open("a+") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        with pytest.raises(OutputError) as told, locked(tmp_path):
            pass
    assert number != "99999999999999999999" or row("lock-number").told(str(told.value))


@pytest.fixture(scope="module")
def stored(tmp_path_factory: pytest.TempPathFactory) -> Path:
    analysis = assimilate(make_problem(Linear(), (1.0, 0.5)), AssimilationSettings(members=8, max_iterations=2), seed=1)
    return Posterior.from_analysis(analysis, {}).save(tmp_path_factory.mktemp("stored") / "posterior.nc")


def altered(stored: Path, folder: Path, group: str, variable: str | None, attribute: str, value: str | None) -> Path:
    """The file with an attribute removed or replaced, sealed again."""
    with xr.open_datatree(stored, engine="netcdf4", decode_timedelta=False) as tree:
        nodes = {node.path: node.to_dataset(inherit=False).load() for node in tree.subtree}
    held = nodes[group].attrs if variable is None else nodes[group][variable].attrs
    del held[attribute]
    if value is not None:
        held[attribute] = value
    xr.DataTree.from_dict(nodes).to_netcdf(folder / "posterior.nc", engine="netcdf4")
    seal_file(folder / "posterior.nc")
    return folder


@pytest.mark.fault("result-incomplete")
def test_a_result_sealed_again_with_a_variable_of_other_dimensions(stored: Path, tmp_path: Path) -> None:
    shutil.copy(stored, tmp_path)
    with h5py.File(tmp_path / "posterior.nc", "r+") as file:
        was = file["sample_stats/influence_change"]
        attributes = {key: was.attrs[key] for key in ("units", "long_name")}
        del file["sample_stats/influence_change"]
        file["sample_stats/influence_change"] = 0.0
        file["sample_stats/influence_change"].attrs.update(attributes)
    seal_file(tmp_path / "posterior.nc")
    told = "posterior.nc: not a result of en4dvar: /sample_stats/influence_change has 0 dimensions instead of 2"
    with pytest.raises(OutputError, match=re.escape(told)):
        write_pages(tmp_path)


@pytest.mark.fault("result-incomplete")
def test_a_result_sealed_again_without_what_is_read(stored: Path, tmp_path: Path) -> None:
    names = list(load_result(stored).posterior.data_vars)
    for place in (
        ("/posterior", names[0], "units", None),
        ("/posterior", names[0], "symbol", r"$\nope$"),
        ("/posterior", names[0], "display_units", "parsec"),
        ("/iterations", names[0], "display_units", None),
        ("/sample_stats", None, "converged", None),
        ("/", None, "dataset", None),
    ):
        folder = altered(stored, tmp_path, *place)
        for kind in ("--csv", "--latex", "--members"):
            done = call("export", folder, kind)
            assert (done.exit_code, type(done.exception)) == (2, SystemExit), (place, kind, done.exception)
            assert row("result-incomplete").told(done.stderr)


FORMULAS = ("=1+1", "+1 mm", "-a", "@SUM(A1)", "\t=1", "\r=1", " =1", "＝1")


@pytest.mark.fault("formula")
def test_a_name_is_no_formula_of_a_spreadsheet(stored: Path) -> None:
    result = load_result(stored)
    text = table_text(summary_rows(((name, result.rows, ()) for name in FORMULAS), {"=lost": "+because"}))
    rows = list(csv.reader(text.splitlines()[:1] + text.splitlines()[-1:]))
    assert (rows[1][0], rows[1][-2]) == ("'=lost", "'+because")
    table = io.StringIO(table_text([[name, -1.5, "-1.5", 1e-300] for name in FORMULAS]), newline="")
    for cells in csv.reader(table):
        assert cells[0].startswith("'")
        assert cells[1:] == ["-1.5", "-1.5", "1e-300"]


@pytest.mark.fault("formula")
def test_a_symbol_is_no_program_of_latex(stored: Path) -> None:
    summary = load_result(stored).rows[0]
    for symbol in (r"$\input{/etc/passwd}$", r"$\write18{ls}$", "$a}b{c$", r"$\def\x{}$", "$%$", "$\n\n$", "x\ny"):
        written = latex_symbol(replace(summary, symbol=symbol))
        assert "\n" not in written
        assert not re.search(r"\\(?!textbackslash|[#$%&_{}^])", written), written
    for symbol in (r"$\mu$", "$R_0$", r"$\frac{1}{2}\mathrm{We}^{2}$"):
        assert latex_symbol(replace(summary, symbol=symbol)) == symbol


@pytest.mark.fault("model-warns")
def test_a_model_may_overflow_without_a_word() -> None:
    class Loud(Linear):
        def step(self, x: Array, t0: float, t1: float) -> Array:
            return x * np.float64(1e300) * np.float64(1e300)

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        (outcome,) = run_chunk(Loud(), np.ones((1, 4)), np.array([0.0, 1.0]))
    assert isinstance(outcome, Failure)
    assert outcome.reason == "non-finite state"


def test_a_terminal_obeys_nothing_in_a_message(tmp_path: Path) -> None:
    assert printable("a\x1b[2Jb\nc\u202ed é 漢 💥") == "a\\x1b[2Jb\nc\\u202ed é 漢 💥"
    path = write_toy(tmp_path, ("unit: ms", r'unit: "\e[2J"'))
    assert "\x1b" not in refused(path)


def test_the_name_of_a_file_is_no_formula_of_a_figure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    path = write_toy(tmp_path, ("toy.csv", "'*.csv'"))
    (tmp_path / r"a$\nope$b.csv").write_text(csv_text(), encoding="utf-8")
    assert call("validate", path, "--plot").exit_code == 0
