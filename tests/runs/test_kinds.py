"""Every kind of run in the registry: it writes what it declares and nothing else, and never replaces a foreign file."""

from __future__ import annotations

import re
from datetime import datetime
from fnmatch import fnmatch
from pathlib import Path

import drift_series
import pytest
import yaml
from click.testing import CliRunner, Result
from rows import row
from run_files import make_campaign
from test_twin_sweep import CONFIG as RING

import en4dvar
from en4dvar.cli import main
from en4dvar.estimation.population import Effort
from en4dvar.plumbing.errors import OutputError
from en4dvar.report import TABLES
from en4dvar.results.kinds import KINDS, kind_in, kind_named
from en4dvar.runs.engine import IDENTITY
from en4dvar.runs.rundir import LISTING, OF_EVERY_RUN, RunDirectory

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
WORKED = {  # as `en4dvar` is called, in a folder with the files of `prepared`
    "estimate": ("run", "campaign/toy.yaml"),
    "sequence": ("run", "series/drift.yaml", "--set", "output.figures=true"),
    "twin": ("run", "ring.yaml"),
    "design": (
        "design", CONFIGS / "linear_design.yaml", "--set", "design.knobs.until.values=[2, 8]",
        "--set", "design.knobs.every.values=[1]", "--set", "design.draws=20", "--set", "design.simulated=20",
    ),
    "sweep-twin": (
        "sweep-twin", "ring.yaml", "--vary", "assimilation.members=[8, 9]", "--seeds", "1", "--workers", "1",
    ),
    "calibrate": ("calibrate", "campaign/toy.yaml", "--sets", "3"),
    "joint": ("joint", "done", "--share", "k"),
    "population": ("population", "done", "--of", "k"),
}  # fmt: skip
IN_PLACE = ("joint", "population")  # replace an earlier result without --force


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Configurations, and a finished campaign of three data sets."""
    folder = tmp_path_factory.mktemp("kinds")
    (folder / "campaign").mkdir()
    make_campaign(folder / "campaign", 3, "execution_models:Swift")
    (folder / "series").mkdir()
    drift_series.write(folder / "series")
    (folder / "ring.yaml").write_text(yaml.safe_dump(RING))
    done = call(folder, "run", "campaign/toy.yaml", "--out", "done", "--no-report")
    assert done.exit_code == 0, done.output
    return folder


def call(folder: Path, *words: object) -> Result:
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        return CliRunner().invoke(main, [str(word) for word in words])


def declared(name: str) -> tuple[str, ...]:
    kind = kind_named(name)
    return (*([] if name in IN_PLACE else OF_EVERY_RUN), *kind.files, *kind.pages)


def contents(folder: Path) -> dict[str, bytes]:
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def test_every_kind_is_tried() -> None:
    assert WORKED.keys() == KINDS.keys()


@pytest.mark.parametrize("name", WORKED)
def test_what_is_written_is_declared(
    prepared: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    small = Effort(hyper_walkers=16, hyper_rounds=20, hyper_components=2, draws=200, effective=20.0)  # for the files
    monkeypatch.setattr("en4dvar.estimation.population.campaign.Effort", lambda: small)
    monkeypatch.setattr("en4dvar.estimation.population.own._emulated", lambda *of: None)
    out = tmp_path / "out"
    done = call(prepared, *WORKED[name], "--out", out)
    assert done.exit_code == 0, done.output
    written = set(contents(out)) - {LISTING}
    known = (*declared(name), IDENTITY, *getattr(kind_named(name), "records", ()))
    assert {file for file in written if not any(fnmatch(file, each) for each in known)} == set()
    assert set((out / LISTING).read_text().splitlines()) == written
    assert kind_in(out) is kind_named(name)
    assert ("report" in kind_named(name).readers) == bool(kind_named(name).pages)
    if kind_named(name).pages:
        page = call(prepared, "report", out)
        assert page.exit_code == 0, page.output
    if name != "estimate" and kind_named(name).pages:
        assert "has one page, of all it holds" in call(prepared, "report", out, "--dataset", "set1").stderr
    if name not in IN_PLACE:
        again = call(prepared, *WORKED[name], "--out", out)
        assert f"not empty: a finished run of {datetime.now():%Y-}" in again.stderr
        assert kind_named(name).writer == "" or f", see {out}/" in again.stderr
        other = next(words for words in WORKED.values() if words[0] != WORKED[name][0])
        told = call(prepared, *other, "--out", out, "--resume")
        assert (told.exit_code, "of another command; give another --out" in told.stderr) == (2, True)
    if name in ("twin", "joint"):  # the directory is the same for all
        again = call(prepared, *WORKED[name], "--out", out, *([] if name in IN_PLACE else ["--force"]))
        assert again.exit_code == 0, again.output
        assert set(contents(out)) - {LISTING} == written


@pytest.mark.parametrize("name", ["estimate", "design", "sweep-twin", "calibrate"])
def test_a_resumed_run_that_begins_is_told_without_out_as_with_it(
    prepared: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    def full(path: Path, mode: str) -> Path:
        raise OutputError(f"{path}: full")

    monkeypatch.setattr("en4dvar.runs.rundir._prepare", full)
    told = call(prepared, *WORKED[name], "--resume").stderr
    assert re.fullmatch(r"note: (\S+) holds no run yet; this one begins\n\1: full\n", told), told


READ = {"rerun": (), "export": (), "compare": ("again",), "joint": (), "population": ("--of", "k")}


@pytest.mark.parametrize("command", READ)
@pytest.mark.parametrize("name", KINDS)
def test_a_command_that_does_not_read_a_kind_of_run_names_it_and_those_that_do(
    tmp_path: Path, name: str, command: str
) -> None:
    """Only the result and its tables are there, and empty: what reads them says that they are damaged."""
    kind = kind_named(name)
    tables = [file for file in kind.files if file.endswith(".csv")]
    for folder in ("done", "again"):
        (tmp_path / folder).mkdir()
        for file in (kind.result, *tables):
            (tmp_path / folder / file).write_bytes(b"")
    done = call(tmp_path, command, "done", *READ[command])
    told = f"done: holds a run of the kind {name}, and no posterior.nc of an estimate"
    if command in kind.readers:
        assert told not in done.stderr
    else:
        assert done.exit_code == 2
        assert told in done.stderr
        assert all(f"en4dvar {reader}" in done.stderr for reader in kind.readers)


@pytest.mark.parametrize("command", {**READ, "report": ()})
@pytest.mark.parametrize("name", KINDS)
def test_a_run_without_a_result_is_named_with_what_continues_it(tmp_path: Path, name: str, command: str) -> None:
    """A killed run of any kind was asked whether it is the directory of a finished one."""
    kind, own = kind_named(name), () if name in IN_PLACE else OF_EVERY_RUN
    for folder in ("done", "again"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / LISTING).write_text("".join(f"{file}\n" for file in (*own, *kind.files, *kind.pages)))
    done = call(tmp_path, command, "done", *{**READ, "report": ()}[command])
    how = "its command" if name in IN_PLACE else "the command of the first line of its run.log with --resume"
    assert done.exit_code == 2
    assert f"done: holds a run of the kind {name} without a result: it was stopped, has failed or is at" in done.stderr
    assert done.stderr.rstrip().endswith(f"; to continue it, repeat {how}")
    assert (tmp_path / "done" / LISTING).read_text().splitlines() == [*own, *kind.files, *kind.pages]


def test_a_table_of_the_same_name_makes_no_run_of_a_kind(tmp_path: Path) -> None:
    """``en4dvar sweep`` writes a table of trajectories called as that of a sweep over twin experiments."""
    (tmp_path / "done").mkdir()
    (tmp_path / "done" / "sweep.csv").write_bytes(b"")
    said = call(tmp_path, "export", "done").stderr
    assert "done: holds no posterior.nc; is it the directory of a finished run?" in said


@pytest.mark.fault("own-files")
@pytest.mark.parametrize("name", WORKED)
def test_a_foreign_file_is_never_replaced(prepared: Path, tmp_path: Path, name: str) -> None:
    """By no kind, under no name that it declares; of these two are tried as a user would."""
    kind = kind_named(name)
    for number, pattern in enumerate(declared(name)):
        out = tmp_path / str(number)
        mine = out / pattern.replace("*", "mine")
        mine.parent.mkdir(parents=True)
        mine.write_text("mine\n")
        told = row("own-files").message.format(run=out, file=mine.relative_to(out).as_posix())
        with (
            pytest.raises(OutputError, match=re.escape(told)),
            RunDirectory.open(out, "beside" if name in IN_PLACE else "force", (*kind.files, *kind.pages)),
        ):
            pass
        if pattern in (kind.result, (*kind.files, *kind.pages)[-1]):
            words = (*WORKED[name], "--out", out, *([] if name in IN_PLACE else ["--force"]))
            refused = call(prepared, *words)
            assert (str(refused.exit_code), told in refused.stderr) == (row("own-files").exit_code, True), (
                refused.output
            )
        assert contents(out) == {mine.relative_to(out).as_posix(): b"mine\n"}


def test_a_page_replaces_no_foreign_file(prepared: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert call(prepared, "run", "campaign/toy.yaml", "--out", out, "--no-report").exit_code == 0
    (out / "report.html").write_text("mine")
    told = call(prepared, "report", out)
    assert told.exit_code == 2
    assert "report.html was not written by a run" in told.stderr
    assert (out / "report.html").read_text() == "mine"


def test_the_tables_of_a_report_are_declared() -> None:
    assert set(TABLES) <= set(kind_named("estimate").pages)


@pytest.mark.parametrize(
    ("conduct", "load", "file"),
    [
        (en4dvar.run, en4dvar.load_config, "campaign/toy.yaml"),
        (en4dvar.run_sequence, en4dvar.load_sequence, "series/drift.yaml"),
        (en4dvar.run_twin, en4dvar.load_twin, "ring.yaml"),
    ],
)
def test_overrides_of_what_is_loaded_already_are_refused(prepared, tmp_path, monkeypatch, conduct, load, file):
    """They would change nothing, without a word."""
    monkeypatch.chdir(tmp_path)
    with pytest.raises(en4dvar.ConfigError, match=f"give them to {load.__name__}"):
        conduct(load(prepared / file), overrides={"seed": 5})
    assert list(tmp_path.iterdir()) == []
