"""A run directory that somebody else has prepared: nothing outside it is written, read without end, or removed."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from click.testing import CliRunner, Result
from rows import row
from run_files import make_campaign

from en4dvar.cli import main
from en4dvar.plumbing.errors import OutputError
from en4dvar.plumbing.files import atomic_path, inside, write_text
from en4dvar.results.pack import PACK
from en4dvar.results.store import COMPLETE, NEXT
from en4dvar.runs.lock import LOCK
from en4dvar.runs.rundir import LISTING, OLD, RunDirectory

pytestmark = [
    pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="links and pipes of POSIX"),
    pytest.mark.usefixtures("one_figure"),
]
SECRET = "mine\n"


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A configuration and the directory of its run."""
    folder = tmp_path_factory.mktemp("done")
    path = make_campaign(folder, 2)
    assert call("run", path, "--out", folder / "run", "--no-report").exit_code == 0
    return path, folder / "run"


@pytest.fixture
def foreign(done: tuple[Path, Path], tmp_path: Path) -> tuple[Path, Path, Path]:
    return beside_own_files(*done, tmp_path)


def beside_own_files(path: Path, run: Path, folder: Path) -> tuple[Path, Path, Path]:
    """A configuration, a directory with its run in ``folder``, and beside it one with the user's own files."""
    shutil.copytree(run, folder / "run")
    outside = folder / "outside"
    outside.mkdir()
    for name in ("rc", "run", ".set0.nc.7.tmp", "ended", "chunk_00000.npz"):
        (outside / name).write_text(SECRET)
    return path, folder / "run", outside


def call(*words: object) -> Result:
    return CliRunner().invoke(main, [str(word) for word in words])


def contents(folder: Path) -> dict[str, bytes]:
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def prepared_next(run: Path, *names: str) -> Path:
    """A run that claims to be complete, and to have written ``names``."""
    following = run / NEXT
    following.mkdir()
    (following / LISTING).write_text("".join(f"{name}\n" for name in names))
    (following / COMPLETE).write_text("")
    return following


def replaced_by_link(place: Path, target: Path) -> None:
    if place.is_dir() and not place.is_symlink():
        shutil.rmtree(place)
    place.unlink(missing_ok=True)
    place.symlink_to(target)


def replaced_by_pipe(place: Path) -> None:
    place.unlink(missing_ok=True)
    os.mkfifo(place)


def leaving_name(run: Path, outside: Path) -> None:
    prepared_next(run, "x/../../outside/rc")
    (run / NEXT / "x").mkdir()
    (run / "x").mkdir()
    (run / "outside").mkdir()  # run/.en4dvar-next/x/../../outside/rc goes to run/x/../../outside/rc
    (run / "outside" / "rc").write_text("evil")


def absolute_name(run: Path, outside: Path) -> None:
    prepared_next(run, str(outside / "rc"))


def linked_folder_of_a_list(run: Path, outside: Path) -> None:
    following = prepared_next(run, "keys/rc")
    (following / "keys").mkdir()
    (following / "keys" / "rc").write_text("evil")
    (run / "keys").symlink_to(outside)


def own_list_leads_out(run: Path, outside: Path) -> None:
    with (run / LISTING).open("a") as listing:
        listing.write("../outside/rc\n")


ATTACKS: dict[str, Callable[[Path, Path], None]] = {
    "a name that leaves": leaving_name,
    "an absolute name": absolute_name,
    "a linked folder of a list": linked_folder_of_a_list,
    "the list of the run leaves": own_list_leads_out,
    "lock": lambda run, outside: replaced_by_link(run / LOCK, outside / "rc"),
    "lock is a hard link": lambda run, outside: os.link(outside / "rc", run / LOCK),
    "lock is a pipe": lambda run, outside: replaced_by_pipe(run / LOCK),
    "checkpoints": lambda run, outside: replaced_by_link(run / "checkpoints", outside),
    "a checkpoint": lambda run, outside: replaced_by_link(run / "checkpoints" / "run", outside / "rc"),
    "a checkpoint is a pipe": lambda run, outside: replaced_by_pipe(run / "checkpoints" / "run"),
    "log": lambda run, outside: replaced_by_link(run / "run.log", outside / "rc"),
    "log is a hard link": lambda run, outside: ((run / "run.log").unlink(), os.link(outside / "rc", run / "run.log")),
    "log is a pipe": lambda run, outside: replaced_by_pipe(run / "run.log"),
    "pack": lambda run, outside: replaced_by_link(run / PACK, outside / "rc"),
    "pack is a hard link": lambda run, outside: ((run / PACK).unlink(), os.link(outside / "rc", run / PACK)),
    "pack is a pipe": lambda run, outside: replaced_by_pipe(run / PACK),
    "figures": lambda run, outside: replaced_by_link(run / "figures", outside),
    "pages": lambda run, outside: replaced_by_link(run / "pages", outside),
    "list": lambda run, outside: replaced_by_link(run / LISTING, outside / "rc"),
    "list is a pipe": lambda run, outside: replaced_by_pipe(run / LISTING),
    "list is no text": lambda run, outside: (run / LISTING).write_bytes(b"\xff\xfe"),
    "next": lambda run, outside: replaced_by_link(run / NEXT, outside),
    "next with a list": lambda run, outside: (
        (outside / LISTING).write_text("rc\n"),
        (outside / COMPLETE).write_text(""),
        replaced_by_link(run / NEXT, outside),
    ),
    "a link in next": lambda run, outside: replaced_by_link(prepared_next(run, "run.log") / "run.log", outside / "rc"),
    "old": lambda run, outside: replaced_by_link(run / OLD, outside),
    "a folder for a file": lambda run, outside: ((run / "summary.csv").unlink(), (run / "summary.csv").mkdir()),
}  # fmt: skip


@pytest.mark.parametrize("attack", ATTACKS.values(), ids=ATTACKS)
@pytest.mark.fault("foreign")
def test_nothing_outside_is_touched(foreign: tuple[Path, Path, Path], attack: Callable[[Path, Path], None]) -> None:
    """Every command that opens the directory: it does its work or refuses in words, and the user's files stay."""
    withstood(*foreign, attack)


def withstood(path: Path, run: Path, outside: Path, attack: Callable[[Path, Path], None]) -> int:
    """How many commands were tried. Raises :class:`AssertionError` where one touches what is outside."""
    attack(run, outside)
    before, tried = contents(outside), 0
    for words in (
        ("report", run),
        ("run", path, "--out", run, "--resume", "--no-report"),
        ("run", path, "--out", run, "--force", "--no-report"),
    ):
        told = call(*words)
        assert told.exit_code in (0, 2), told.exception
        assert told.exit_code == 0 or told.stderr.count("\n") == 1
        assert contents(outside) == before, words
        tried += 1
    return tried


@pytest.mark.fault("foreign")
def test_a_link_is_named(foreign: tuple[Path, Path, Path]) -> None:
    path, run, outside = foreign
    replaced_by_link(run / "checkpoints", outside)
    told = call("run", path, "--out", run, "--resume")
    assert told.exit_code == int(row("foreign").exit_code)
    assert row("foreign").told(told.stderr)
    assert str(run / "checkpoints") in told.stderr


@pytest.mark.parametrize("words", [("report",), ("export", "--csv"), ("export", "--netcdf"), ("compare",), ("rerun",)])
@pytest.mark.fault("half-replaced")
def test_who_reads_finishes_no_replacement(foreign: tuple[Path, Path, Path], words: tuple[str, ...]) -> None:
    path, run, _ = foreign
    (prepared_next(run, "run.log") / "run.log").write_text("new")
    before = contents(run)
    told = call(words[0], run, *words[1:], *([path.parent / "run"] if words[0] == "compare" else []))
    assert told.exit_code == int(row("half-replaced").exit_code)
    assert row("half-replaced").told(told.stderr)
    assert contents(run) == before


@pytest.mark.parametrize(
    "words", [("export", "--csv"), ("export", "--members"), ("compare", "--no-report"), ("rerun",)]
)
@pytest.mark.fault("half-replaced")
def test_who_reads_writes_nothing(foreign: tuple[Path, Path, Path], words: tuple[str, ...]) -> None:
    path, run, _ = foreign
    before = contents(run)
    told = call(words[0], run, *words[1:], *([path.parent / "run"] if words[0] == "compare" else []))
    assert told.exit_code == 0, told.stderr
    assert contents(run) == before


def test_a_result_that_is_a_pipe_is_refused(foreign: tuple[Path, Path, Path]) -> None:
    """Opening it would wait for ever."""
    _, run, _ = foreign
    (run / PACK).unlink()
    os.mkfifo(run / PACK)
    told = call("export", run)
    assert told.exit_code == 2
    assert "datasets.pack: cannot be read: is a pipe, not a file" in told.stderr


def test_a_linked_folder_for_a_comparison_is_not_followed(foreign: tuple[Path, Path, Path]) -> None:
    _, run, outside = foreign
    shutil.copytree(run, run.with_name("other"))
    (run.parent / "compare_run_other").symlink_to(outside)
    before = contents(outside)
    told = call("compare", run, run.with_name("other"))
    assert told.exit_code == 2
    assert "compare_run_other: is a symbolic link" in told.stderr
    assert contents(outside) == before


def test_a_run_directory_may_be_a_link_of_the_user(done: tuple[Path, Path], tmp_path: Path) -> None:
    """He names it; what lies in it is judged, not the way to it."""
    (tmp_path / "far" / "away").mkdir(parents=True)
    (tmp_path / "near").symlink_to(tmp_path / "far")
    (tmp_path / "out").symlink_to(tmp_path / "near" / "away")
    assert call("run", done[0], "--out", tmp_path / "out", "--no-report").exit_code == 0
    assert call("run", done[0], "--out", tmp_path / "out", "--no-report", "--resume").exit_code == 0
    assert call("report", tmp_path / "out").exit_code == 0
    assert (tmp_path / "far" / "away" / "report.html").is_file()


def test_links_of_the_user_beside_the_run_are_left_alone(foreign: tuple[Path, Path, Path]) -> None:
    path, run, outside = foreign
    (run / "my data").symlink_to(outside)
    assert call("run", path, "--out", run, "--force", "--no-report").exit_code == 0
    assert (run / "my data").is_symlink()


@pytest.mark.parametrize("name", ["", ".", "..", "../x", "a/../../x", "/etc/x", "a\0b"])
def test_names_that_lead_elsewhere(tmp_path: Path, name: str) -> None:
    with pytest.raises(OutputError, match="is not the name of a file in this directory"):
        inside(tmp_path, name)


def test_a_name_below_a_file(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="Not a directory"):
        inside(tmp_path, "file/x/y")


def test_a_partial_file_that_is_there_as_a_link_is_not_written_to(tmp_path: Path) -> None:
    (tmp_path / "rc").write_text(SECRET)
    (tmp_path / f".x.txt.{os.getpid()}.tmp").symlink_to(tmp_path / "rc")
    write_text(tmp_path / "x.txt", "new")
    with atomic_path(tmp_path / "y.txt") as partial:
        partial.write_text("new")
    assert (tmp_path / "rc").read_text() == SECRET


def test_a_file_of_a_run_goes_through_the_directory(tmp_path: Path) -> None:
    with RunDirectory.open(tmp_path / "run") as directory:
        for write in (directory.at, directory.claim, directory.folder, directory.remove):
            with pytest.raises(OutputError, match="is not the name of a file"):
                write("../x")
