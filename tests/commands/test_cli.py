"""The command line from outside: files, tables, exit codes, and one clear message for each bad input."""

from __future__ import annotations

import re
import signal
from collections.abc import Callable
from dataclasses import replace
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from click.testing import CliRunner, Result
from field_models import Line, write_line
from toy_config import YAML, csv_text, write_toy

from en4dvar.cli import main
from en4dvar.commands.run import _tell, _Warnings
from en4dvar.config import load_config
from en4dvar.estimation.summary import ParameterSummary, brief
from en4dvar.model.state import StateLayout
from en4dvar.plumbing.caution import caution
from en4dvar.report.figures import FIGURES
from en4dvar.report.result import load_result
from en4dvar.results.pack import PACK
from en4dvar.runs.campaign import Campaign, DatasetOutcome


def call(*arguments: str | Path) -> Result:
    return CliRunner().invoke(main, [str(a) for a in arguments])


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Result]:
    """A run of the toy configuration, of whose figures two are drawn: its directory and what the command said."""
    folder = tmp_path_factory.mktemp("finished")
    two = tuple(figure for figure in FIGURES if figure[0] in ("posterior", "history"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("en4dvar.report.figures.FIGURES", two)
        outcome = call("run", write_toy(folder), "--out", folder / "run", "--set", "output.figures=true")
    return folder / "run", outcome


def test_run_writes_the_run_directory(finished: tuple[Path, Result]) -> None:
    directory, outcome = finished
    assert outcome.exit_code == 0, outcome.output
    names = {p.relative_to(directory).as_posix() for p in directory.rglob("*") if p.is_file()}
    assert {"config.yaml", "config.resolved.yaml", "posterior.nc", "run.log", "report.html", "summary.csv"} < names
    assert {"figures/posterior.pdf", "figures/posterior.png", "figures/history.pdf"} < names
    assert names == {".en4dvar-files", *(directory / ".en4dvar-files").read_text().split()}
    assert (directory / "config.yaml").read_text() == YAML
    again = load_config(directory / "config.resolved.yaml")
    assert again.assimilation.members == 8
    log = (directory / "run.log").read_text()
    iterations = re.findall(r"toy: iteration +\d+  J [\d.e+-]+ = .* active 8", log)
    result = load_result(directory / "posterior.nc")
    assert len(iterations) == result.iterations.sizes["iteration"]
    assert log.endswith("done\n")


def test_run_recovers_the_truth_and_prints_it(finished: tuple[Path, Result]) -> None:
    directory, outcome = finished
    stiffness = {row.name: row for row in load_result(directory / "posterior.nc").rows}["k"]
    assert abs(stiffness.mean - 2.0) < 4 * stiffness.std
    assert stiffness.std < 0.05
    assert re.search(rf"^toy +k +N/m +{stiffness.mean:.4g} +{stiffness.std:.4g} ", outcome.stdout, re.MULTILINE)
    assert outcome.stdout.rstrip().endswith(f"report: {directory / 'report.html'}")


def test_workers_and_executors_do_not_change_the_numbers(tmp_path: Path, finished: tuple[Path, Result]) -> None:
    outcome = call(
        "run", write_toy(tmp_path), "--out", tmp_path / "run", "--workers", "2", "--no-report",
        "--set", "execution.executor=threads",
    )  # fmt: skip
    assert outcome.exit_code == 0, outcome.output
    one, two = (load_result(d / "posterior.nc").posterior for d in (finished[0], tmp_path / "run"))
    assert one.identical(two)


def test_campaign(tmp_path: Path) -> None:
    path = write_toy(tmp_path)
    for n in (1, 2):
        (tmp_path / f"set{n}.csv").write_text(csv_text(k=1.5 + n / 4))
    outcome = call("run", path, "--out", tmp_path / "run", "--data", tmp_path / "set*.csv", "--no-report")
    assert outcome.exit_code == 0, outcome.output
    results = [load_result(tmp_path / "run" / PACK / f"set{n}") for n in (1, 2)]
    assert [r.name for r in results] == ["set1", "set2"]
    means = [r.rows[1].mean for r in results]
    assert means == pytest.approx([1.75, 2.0], rel=0.02)
    with xr.open_datatree(tmp_path / "run" / "posterior.nc") as tree:
        assert tree["posterior"]["k"].sizes == {"dataset": 2, "chain": 1, "draw": 8}
        assert tree["posterior"]["k"].mean(("chain", "draw")).values == pytest.approx(means, rel=1e-12)


@pytest.mark.usefixtures("one_figure")
def test_report_again(tmp_path: Path) -> None:
    call("run", write_toy(tmp_path), "--out", tmp_path / "run", "--no-report")
    assert not (tmp_path / "run" / "report.html").exists()
    outcome = call("report", tmp_path / "run")
    assert outcome.exit_code == 0
    assert (tmp_path / "run" / "report.html").stat().st_size > 10_000
    assert call("report", tmp_path / "nowhere").exit_code == 2
    unknown = call("report", tmp_path / "run", "--dataset", "toys")
    assert unknown.exit_code == 2
    assert "no data set 'toys'; did you mean 'toy'?" in unknown.stderr


@pytest.mark.parametrize("out", [".", "..", "../.."])
def test_a_folder_without_a_name_of_its_own_is_not_empty_either(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, out: str
) -> None:
    within = tmp_path / "a" / "b"
    within.mkdir(parents=True)
    config = write_toy(within)
    monkeypatch.chdir(within)
    (tmp_path / "a" / "mine.txt").write_text("")
    (tmp_path / "mine.txt").write_text("")
    outcome = call("run", config, "--out", out)
    assert outcome.exit_code == 2
    folder = (within / out).resolve()
    assert f"{out}: not empty, and not of a run; --out {folder.parent / folder.name}_2 keeps both" in outcome.stderr


def test_validate_tells_what_would_be_estimated(tmp_path: Path) -> None:
    outcome = call("validate", write_toy(tmp_path))
    assert outcome.exit_code == 0, outcome.output
    assert "2 parameters from 1 data set with en4dvar, 8 members" in outcome.stdout
    assert re.search(r"^toy +31 +0 to 0.15 s +100 um +2 um$", outcome.stdout, re.MULTILINE)
    assert re.search(r"^k +N/m +lognormal +3 +1\.832 +4\.914$", outcome.stdout, re.MULTILINE)
    assert re.search(r"^c +0\.02 +N s/m$", outcome.stdout, re.MULTILINE)
    assert not (Path("runs") / "toy").exists()


def test_simulated_data_name_no_folder_of_the_machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_toy(tmp_path)
    monkeypatch.setattr("sys.argv", ["en4dvar", "simulate", str(path)])
    assert call("simulate", path).stdout.splitlines()[0] == f"# en4dvar simulate {path.name}"


def test_simulate_makes_data_that_can_be_read_back(tmp_path: Path) -> None:
    path = write_toy(tmp_path)
    out = tmp_path / "synthetic.csv"
    truth = ["--set", "parameters.A=100 um", "--set", "parameters.k=2 N/m"]
    assert call("simulate", path, *truth, "--out", out).exit_code == 0
    simulated, exact = (np.loadtxt(t.splitlines()[-31:], delimiter=",") for t in (out.read_text(), csv_text()))
    assert np.allclose(simulated, exact, atol=1e-3)
    assert "# parameters: c = 0.02 N s/m" not in out.read_text()  # in the model's order
    assert "# parameters: A = 0.0001 m, k = 2 N/m, c = 0.02 N s/m" in out.read_text()
    assert call("validate", path, "--data", out).exit_code == 0
    assert call("simulate", path, "--out", out).exit_code == 2  # exists
    assert call("simulate", path, "--out", out, "--force").exit_code == 0


def test_simulate_without_data(tmp_path: Path) -> None:
    path = write_toy(tmp_path)
    (tmp_path / "toy.csv").unlink()
    grid = ["--set", "simulate.times={from: 0 ms, to: 150 ms, step: 5 ms}", "--set", "parameters.A=100 um"]
    clean, noisy, again, other = (
        call("simulate", path, *grid, *extra).stdout
        for extra in (
            [],
            ["--noise", "1 % of maximum"],
            ["--noise", "1 um", "--seed", "3"],
            ["--noise", "1 um", "--seed", "4"],
        )
    )
    values = [np.loadtxt(text.splitlines()[-31:], delimiter=",")[:, 1] for text in (clean, noisy, again, other)]
    assert values[0][0] == 100
    assert np.std(values[1] - values[0]) == pytest.approx(1.0, rel=0.4)
    assert np.array_equal(values[1], values[2])
    assert not np.array_equal(values[2], values[3])
    outcome = call("simulate", path, "--times", "0 ms:150 ms:5 ms")
    assert outcome.exit_code == 2
    assert "toy.csv: no such file" in outcome.stderr
    for bad in ("0 ms:1 ms", "0:1:2", "0 ms:1 ms:-1 ms"):
        assert call("simulate", path, *grid, "--times", bad).exit_code == 2


def replaced(old: str, new: str) -> Callable[[Path], list[str | Path]]:
    return lambda folder: ["run", write_toy(folder, (old, new)), "--out", folder / "out"]


def with_data(data: str) -> Callable[[Path], list[str | Path]]:
    return lambda folder: ["run", write_toy(folder, data=data), "--out", folder / "out"]


def full_directory(folder: Path) -> list[str | Path]:
    (folder / "out").mkdir()
    (folder / "out" / "notes.txt").write_text("mine")
    return ["run", write_toy(folder), "--out", folder / "out"]


def damaged(path: Path) -> Path:
    path.write_bytes(b"MATLAB\x80\xff")
    return path


HEAD = "t_ms,x_um\n"
BAD: dict[str, tuple[Callable[[Path], list[str | Path]], str]] = {
    "no configuration": (lambda f: ["run", f / "toi.yaml"], "toi.yaml: no such file"),
    "missing file": (replaced("toy.csv", "toi.csv"), "toi.csv: no such file; the folder holds toy.csv"),
    "missing --data": (lambda f: ["run", write_toy(f), "--data", f / "x.csv"], "x.csv: no such file"),
    "wrong column": (replaced("x_um", "R_um"), "toy.csv: no column 'R_um'; the columns are: t_ms, x_um"),
    "missing unit": (replaced(", unit: um", ""), "toy.yaml:7:5: data.columns.position.unit: required"),
    "unknown key": (replaced("seed:", "sede:"), "toy.yaml:2:1: sede: unknown key 'sede'; did you mean 'seed'?"),
    "duplicate key": (replaced("seed: 3", "seed: 3\nseed: 4"), "toy.yaml:3:1: duplicate key 'seed'"),
    "no unit": (replaced("2 um", "1e-6"), "toy.yaml:8:25: data.error.position_std: 1e-06 has no unit"),
    "negative std": (replaced("2 um", "-2 um"), "toy.yaml:8:25: data.error.position_std: must be positive"),
    "negative prior std": (replaced("std: 1 %", "std: -1 um"), "toy.yaml:13:42: parameters.A.std: must be positive"),
    "empty data": (with_data(""), "toy.csv: the file holds no data"),
    "all NaN": (with_data(HEAD + "0,nan\n1,nan\n2,nan\n3,\n"), "toy.csv: 'x_um' holds no usable value"),
    "non-monotone": (with_data(HEAD + "0,1\n2,1\n1,1\n3,1\n"), "toy.csv:4: times must increase"),
    "few observations": (with_data(HEAD + "0,1\n1,1\n"), "toy.csv: 2 usable observations; at least 3"),
    "unknown law": (replaced("mass: 2 g", "law: cubik"), "toy.yaml:11:8: model.law: 'cubik' is not one of"),
    "no prior": (replaced("  A: {prior: normal, mean: maximum, std: 1 %}\n", ""), "toy.yaml:12:1: parameters.A: "),
    "not empty": (full_directory, "out: not empty, and not of a run; --out "),
    "data as configuration": (lambda f: ["run", damaged(f / "A.mat")], "A.mat' looks at the readings and proposes one"),
    "readings as configuration": (lambda f: ["run", write_toy(f).with_suffix(".csv")], "toy.csv: a data file, not a"),
    "a folder as configuration": (lambda f: ["run", f], "a folder, not a configuration; 'en4dvar init --data "),
    "no number": (lambda f: ["population", f, "--of", "k", "--spread", "nan"], "nan is not a finite number"),
    "no finite number": (lambda f: ["population", f, "--of", "k", "--mean-std", "inf"], "inf is not a finite number"),
    "a key varied twice": (
        lambda f: ["sweep-twin", write_toy(f), "--vary", "a=[1]", "--vary", "a=[2]"],
        "--vary: give all values of a key in one list",
    ),
    "unwritable": (lambda f: ["run", write_toy(f), "--out", f / "toy.csv" / "out"], "cannot be used as run directory"),
    "a file as directory": (lambda f: ["run", write_toy(f), "--out", f / "toy.csv"], "cannot be used as run directory"),
    "an unquoted pattern": (lambda f: ["run", write_toy(f), "--data", "a", "b"], "b: there is one configuration; many"),
    "bad --set": (lambda f: ["run", write_toy(f), "--set", "members"], "'members' is not KEY=VALUE"),
    "unknown --set": (lambda f: ["run", write_toy(f), "--set", "assimilation.x=1"], "--set assimilation.x: "),
    "unknown command": (lambda f: ["rum"], "No such command 'rum'"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_bad_input(tmp_path: Path, case: str) -> None:
    arguments, message = BAD[case]
    outcome = call(*arguments(tmp_path))
    assert outcome.exit_code == 2
    assert outcome.stdout == ""
    assert outcome.stderr.count(message) == 1
    assert "Traceback" not in outcome.stderr
    assert len(outcome.stderr.splitlines()) == (4 if "Usage" in outcome.stderr else 1)
    assert not (tmp_path / "out").exists() or case == "not empty"


def test_lost_ensemble(tmp_path: Path) -> None:
    outcome = call("run", write_toy(tmp_path), "--out", tmp_path / "out", "--set", "model.name=toy_models:Fragile")
    assert outcome.exit_code == 3
    assert len(outcome.stderr.splitlines()) == 1
    assert "failed: TooFewMembersError" in (tmp_path / "out" / "run.log").read_text()


@pytest.mark.slow
@pytest.mark.usefixtures("one_figure")
def test_interrupted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    path, out = write_toy(tmp_path), tmp_path / "out"
    monkeypatch.setattr("en4dvar.runs.worklist.assimilate", interrupt)
    monkeypatch.setattr("sys.argv", ["en4dvar", "run", str(path), "--out", str(out), "--force"])
    outcome = call("run", path, "--out", out)
    assert outcome.exit_code == 130
    assert outcome.stderr.splitlines() == [
        f"interrupted; 0 of 1 data sets are done and kept in {out}",
        f"to continue: en4dvar run {path} --out {out} --resume",
    ]
    monkeypatch.undo()
    assert call("run", path, "--out", out, "--resume", "--no-report").exit_code == 0
    assert "resumed: 0 of 1 data sets are done" in (out / "run.log").read_text()


@pytest.mark.slow
@pytest.mark.usefixtures("one_figure")
def test_force_removes_what_a_run_wrote_and_nothing_else(tmp_path: Path) -> None:
    path, out = write_toy(tmp_path), tmp_path / "out"
    assert call("run", path, "--out", out, "--set", "output.figures=true").exit_code == 0
    (out / "notes.txt").write_text("mine")
    (out / "figures" / "mine.txt").write_text("mine")
    (tmp_path / "other.csv").write_text(csv_text())
    outcome = call("run", path, "--out", out, "--force", "--data", tmp_path / "*.csv")
    assert outcome.exit_code == 0, outcome.output
    assert (out / "notes.txt").read_text() == (out / "figures" / "mine.txt").read_text() == "mine"
    assert (out / PACK).exists()
    assert not (out / "figures" / "posterior.png").exists()
    assert call("run", path, "--out", out, "--force").exit_code == 0
    assert not (out / PACK).exists()
    (out / ".en4dvar-files").unlink()  # now nothing tells that a run wrote the files
    refused = call("run", path, "--out", out, "--force")
    assert refused.exit_code == 2
    assert "was not written by a run" in refused.stderr


@pytest.mark.parametrize(
    ("mean", "std", "words"),
    [(8.02e-9, 4.1e-10, "8.02e-09 ± 4.1e-10"), (1e3, 2e-6, "1000 ± 2e-06"), (0.4, 0.12, "0.40 ± 0.12")],
)
def test_a_small_number_keeps_its_digits_in_the_line_of_an_estimate(mean: float, std: float, words: str) -> None:
    row = ParameterSummary("kappa_s", "", "", "kg/s", 0.0, 1.0, mean, std, 0.0, 0.0, 0.0, 0.0, 1.0)
    assert brief([row]) == f"kappa_s {words} kg/s"


def test_warnings_of_a_campaign_are_counted_by_kind(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    said = caution("not-informed", "k is hardly informed"), caution("misfit", "χ² is large")
    worst = *said, caution("not-converged", "stopped")
    row = ParameterSummary("k", "k", "k", "N/m", *np.arange(1.0, 10.0))
    outcomes = [DatasetOutcome(f"set{n}", tmp_path / "none.nc", warnings=said, summary=(row,)) for n in range(40)]
    outcomes[7] = DatasetOutcome("set7", tmp_path / "none.nc", warnings=worst, summary=(row,), remarks=("what if",))
    _tell(Campaign(tmp_path, tuple(outcomes)), with_report=False)
    told = capsys.readouterr()
    assert told.out.splitlines()[1].split() == ["k", "N/m", "40", "40", "3", "3", "3"]
    lines = told.err.splitlines()
    assert lines[0].startswith("warning: set7: stopped; raise assimilation.max_iterations")
    assert lines[1].startswith(
        "warning: 40 of 40 data sets, worst set7, set0, set1: misfit (residuals are larger than the errors explain); l"
    )
    assert lines[2].startswith(
        "note: 40 of 40 data sets, worst set7, set0, set1: not-informed (a parameter is known from its prior alone); "
    )
    assert lines[3:] == ["what was found in each of them: run.log and the report"]
    _tell(Campaign(tmp_path, outcomes[:1]), with_report=False)
    assert [line.split(":")[0] for line in capsys.readouterr().err.splitlines()] == ["warning", "note"]


def test_warnings_of_fits_that_only_begin_a_joint_estimate_are_one_line() -> None:
    """What is serious in one of them is told as ever, and so is what the joint estimate has too."""
    told = _Warnings()
    told.joint = True
    for n in range(6):
        told.add(f"set{n}", [caution("non-gaussian", "bent"), caution("not-informed", "k"), caution("misfit", "χ²")])
    told.add("all together", [caution("not-informed", "c")], whole=True)
    serious, of_both, begun, _ = told.lines()
    assert serious.startswith(
        "warning: 6 of 6 data sets, worst set0, set1, set2: misfit (residuals are larger than the errors explain); "
    )
    assert of_both.startswith("note: all together and 6 of 6 data sets, worst set0, set1, set2: not-informed (a ")
    whole = "non-gaussian (mean ± std describe the posterior badly) in 6"
    assert begun == f"note: the fits of the 6 single data sets only begin the joint estimate: {whole}"


def test_what_sets_have_together_is_no_data_set(tmp_path: Path) -> None:
    """Of populations the warnings are told by name, beside the count of data sets."""
    told = _Warnings()
    for n in range(6):
        told.add(f"set{n}", [caution("misfit", "χ² is large")] * (n < 4))
    for gel in ("a", "b"):
        told.add(
            f"the population of {gel}", [caution("misfit", "in a"), caution("chain-not-converged", gel)], whole=True
        )
    lines = "\n".join(told.lines())
    assert (
        "the population of a, the population of b and 4 of 6 data sets, worst set0, set1, set2: misfit (residuals"
        in lines
    )
    assert "the population of a, the population of b: chain-not-converged (the draws have not settled); " in lines
    one = _Warnings()
    one.add("set1", [])
    one.add("set2", [caution("lost-frame", "after the reading at 2 s")])
    one.add("the population", [caution("lost-frame", "of single data sets, set2: after", "caution")], whole=True)
    assert next(one.lines()).startswith("warning: the population and set2: after the reading at 2 s; look at")
    alone = _Warnings()
    alone.add("the population", [caution("chain-not-converged", "few draws")], whole=True)
    assert "the population: few draws" in "\n".join(alone.lines())


def test_a_run_of_a_field_alone_tells_how_far_it_is_narrowed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The head of a table without rows was all that the terminal showed. Units are those of the page."""
    u, offset = Line.layout.fields
    monkeypatch.setattr(Line, "layout", StateLayout((replace(u, display_unit="mK"), offset)))
    done = call("run", write_line(tmp_path), "--out", tmp_path / "run", "--no-report")
    told = re.fullmatch(r"line: (u of 30 cells: standard deviation (\S+) mK after the readings, .*)\n", done.stdout)
    assert told, done.output
    stds = load_result(tmp_path / "run" / "posterior.nc").dataset("fields")["u_std"].values
    assert float(told[2]) == pytest.approx(1e3 * np.sqrt(np.mean(stds**2)), rel=0.01)
    assert f"line: estimate: {told[1]}\n" in (tmp_path / "run" / "run.log").read_text(encoding="utf-8")


def test_a_run_that_is_there_is_named_with_what_to_type(tmp_path: Path) -> None:
    arguments = ["run", write_toy(tmp_path), "--out", tmp_path / "out", "--no-report"]
    assert call(*arguments).exit_code == 0
    again = call(*arguments)
    assert again.exit_code == 2
    assert f"a finished run of {datetime.now():%Y-}" in again.stderr
    assert f"--force replaces it, --out {tmp_path / 'out_2'} keeps both" in again.stderr
    (tmp_path / "out" / "posterior.nc").unlink()
    assert "a run; --resume continues it if it has not ended" in call(*arguments).stderr


def test_a_stop_by_the_system_is_heeded_by_every_command(monkeypatch: pytest.MonkeyPatch) -> None:
    """A command that is no run ended where it stood, and its temporary folders stayed."""

    def stopped() -> str:
        assert signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL
        signal.raise_signal(signal.SIGTERM)
        return "models"

    monkeypatch.setattr("en4dvar.config.models.model_listing", stopped)
    outcome = call("models")
    assert (outcome.exit_code, outcome.output) == (130, "terminated\n")
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
