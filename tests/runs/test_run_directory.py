"""One run at a time; an earlier result stays until the new one is complete, wherever the new one fails."""

import errno
import fcntl
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from click.testing import CliRunner
from rows import row
from run_files import assert_same_results, command, configuration, environment, make_campaign
from toy_config import write_toy

from en4dvar.cli import main
from en4dvar.plumbing import files
from en4dvar.plumbing.errors import DataError, OutputError, TooFewMembersError
from en4dvar.results.pack import PACK, results_of
from en4dvar.runs import engine, rundir
from en4dvar.runs.lock import LOCK, locked
from en4dvar.runs.rerun import rerun
from en4dvar.runs.rundir import LISTING, NEXT, RunDirectory
from en4dvar.runs.runner import run, run_campaign


def contents(folder):
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


@pytest.mark.fault("two-runs")
@pytest.mark.fault("stale-lock")
def test_second_run_is_refused_and_a_dead_one_is_not_in_the_way(tmp_path):
    path, out = write_toy(tmp_path, ("toy_models:Oscillator", "execution_models:Slow")), tmp_path / "run"
    words = command("run", path, "--out", out, "--no-report")
    first = subprocess.Popen(words, env=environment(EN4DVAR_TEST_PAUSE=5), stderr=subprocess.PIPE, text=True)
    try:
        while first.poll() is None and not (out / "checkpoints" / "run").exists():
            time.sleep(0.01)
        for mode in ("new", "force", "resume", "report"):
            with pytest.raises(OutputError, match=rf"in use by process {first.pid} on "), RunDirectory.open(out, mode):
                pass
    finally:
        first.send_signal(signal.SIGKILL)
        first.communicate()
    assert (out / LOCK).exists()
    assert run(configuration(path, out), resume=True).name == "toy"
    assert not (out / LOCK).exists()


def test_lock_goes_with_its_holder(tmp_path):
    with locked(tmp_path):
        script = (
            f"from en4dvar.runs.lock import locked\nwith locked(__import__('pathlib').Path({str(tmp_path)!r})): pass"
        )
        other = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
        assert "in use by process" in other.stderr
    with locked(tmp_path):
        pass


@pytest.mark.fault("no-locks")
@pytest.mark.parametrize("number", ["ENOLCK", "EOPNOTSUPP"])
def test_a_file_system_without_locks_refuses_no_run(tmp_path, monkeypatch, number):
    """Some network file systems have none; the bits are those of any other."""
    path, out = write_toy(tmp_path), tmp_path / "run"
    run(configuration(path, tmp_path / "quiet"))
    tried = []

    def unknown(file, how):
        tried.append(how)
        raise OSError(getattr(errno, number), os.strerror(getattr(errno, number)))

    monkeypatch.setattr(fcntl, "flock", unknown)
    assert run(configuration(path, out)).name == "toy"
    assert tried
    assert not (out / LOCK).exists()
    assert_same_results(out, tmp_path / "quiet")


def test_a_lock_that_fails_is_one_line_and_is_nobodys(tmp_path, monkeypatch):
    def broken(*_):
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    monkeypatch.setattr(fcntl, "flock", broken)
    with pytest.raises(OutputError, match=r"cannot be used as run directory: Input/output error$"):
        RunDirectory.open(tmp_path / "run", "new").__enter__()


@pytest.fixture
def earlier(tmp_path):
    path = make_campaign(tmp_path, 2, "execution_models:Breaks")
    run_campaign(configuration(path, tmp_path / "run"))
    (tmp_path / "run" / "notes.txt").write_text("mine")
    return path, tmp_path / "run"


def test_a_failed_replacement_leaves_the_earlier_result(earlier):
    path, out = earlier
    before = contents(out)
    (path.parent / "data" / "set1.csv").unlink()
    large = (path.parent / "data" / "set0.csv").read_text().replace("x_um", "x_um").splitlines()
    large = [*large[:2], *(f"{t},{2 * float(x)}" for t, x in (row.split(",") for row in large[2:]))]
    (path.parent / "data" / "set0.csv").write_text("\n".join(large))
    with pytest.raises(TooFewMembersError):
        run_campaign(configuration(path, out), force=True)
    after = contents(out)
    assert {k: v for k, v in after.items() if not k.startswith(NEXT)} == before
    assert "failed: TooFewMembersError" in (out / NEXT / "run.log").read_text()


def test_replacement(earlier):
    path, out = earlier
    (path.parent / "data" / "set1.csv").rename(path.parent / "data" / "other.csv")
    run_campaign(configuration(path, out), force=True)
    assert [p.name for p in results_of(out / PACK)] == ["other", "set0"]
    assert (out / "notes.txt").read_text() == "mine"
    assert not (out / NEXT).exists()


def test_a_pattern_in_the_list_stands_for_the_files_that_are_there(tmp_path):
    """As that of the checkpoints of a campaign, of which a killed run leaves some behind."""
    out, names = tmp_path / "run", {"a.iteration", "b.iteration", "mine.txt"}
    with RunDirectory.open(out) as directory:
        directory.claim("run.log", "checkpoints/*.iteration")
        folder = directory.folder("checkpoints")
        for file in (out / "run.log", *(folder / name for name in names)):
            file.write_text("old")
    with RunDirectory.open(out, "force") as directory:
        directory.claim("run.log")
        directory.at("run.log").write_text("new")
        directory.publish()
    assert {name for name in contents(out) if name.startswith("checkpoints/")} == {"checkpoints/mine.txt"}
    assert (out / "run.log").read_text() == "new"


def test_replacement_interrupted_anywhere_is_finished_later(earlier, monkeypatch):
    path, out = earlier
    kept = out.with_name("kept")
    shutil.copytree(out, kept)
    (path.parent / "data" / "set1.csv").rename(path.parent / "data" / "other.csv")
    run_campaign(configuration(path, out), force=True)
    expected = contents(out)
    steps = 0
    moved = rundir.Path.replace

    def dies(self, target):
        nonlocal steps
        if (NEXT in self.parts and self.parent.name != NEXT) or self.name in ("posterior.nc", PACK):
            steps -= 1
            if steps == 0:
                raise KeyboardInterrupt
        return moved(self, target)

    shutil.rmtree(out)
    kept.rename(out)
    monkeypatch.setattr(rundir, "replace_earlier_run", lambda path: None)
    run_campaign(configuration(path, out), force=True)  # complete, but not yet in place
    monkeypatch.undo()
    shutil.copytree(out, kept)
    interrupted = 0
    for at in range(1, 30):
        shutil.rmtree(out)
        shutil.copytree(kept, out)
        steps = at
        monkeypatch.setattr(rundir.Path, "replace", dies)
        try:
            with RunDirectory.open(out, "resume"):
                pass
        except KeyboardInterrupt:
            interrupted += 1
        monkeypatch.undo()
        with RunDirectory.open(out, "resume"):
            pass
        assert contents(out).keys() == expected.keys()
        assert not (out / NEXT).exists()
        if steps > 0:
            break
    assert interrupted > 2


def test_resume_continues_an_interrupted_replacement(earlier, monkeypatch):
    path, out = earlier
    quiet = out.with_name("quiet")
    run_campaign(configuration(path, quiet))
    before = contents(out)

    def full(*_, **__):
        raise OutputError("disk full")

    monkeypatch.setattr("en4dvar.runs.runner.save_campaign", full)
    with pytest.raises(OutputError, match="disk full"):
        run_campaign(configuration(path, out), force=True)
    monkeypatch.undo()
    assert {k: v for k, v in contents(out).items() if not k.startswith(NEXT)} == before
    run_campaign(configuration(path, out), resume=True)
    assert not (out / NEXT).exists()
    assert_same_results(out, quiet)


@pytest.mark.fault("requeued")
@pytest.mark.parametrize("left", ["nothing", "an empty folder", "an empty list and a lock"])
def test_resume_of_a_job_killed_before_it_began(tmp_path, left):
    path, out = write_toy(tmp_path), tmp_path / "run"
    if left != "nothing":
        out.mkdir()
    if left == "an empty list and a lock":
        (out / rundir.LISTING).write_text("")
        (out / LOCK).write_text("process 1 on nowhere\n")
        assert run(configuration(path, out)).name == "toy"  # without --resume, too
        shutil.rmtree(out)
    found = CliRunner().invoke(main, ["run", str(path), "--out", str(out), "--no-report", "--resume"])
    assert found.exit_code == int(row("requeued").exit_code), found.stderr
    assert row("requeued").told(found.stderr)
    again = CliRunner().invoke(main, ["run", str(path), "--out", str(out), "--no-report", "--resume"])
    assert again.exit_code == 0
    assert "note: " not in again.stderr


@pytest.mark.fault("disk-failing")
@pytest.mark.parametrize("failing", [LISTING, "config.yaml"])
def test_a_run_that_could_not_begin_is_begun_by_resume(tmp_path, monkeypatch, failing):
    """Full before the files of the run are listed, or right after: nothing is left that looks like another's."""
    path, out = write_toy(tmp_path), tmp_path / "run"
    written = files.write_text

    def full(file, text):
        if file.name == failing and (text or failing != LISTING):  # an empty list fits
            raise OutputError(f"{file}: cannot be written: No space left on device")
        return written(file, text)

    for module in (rundir, engine):
        monkeypatch.setattr(module, "write_text", full)
    with pytest.raises(OutputError, match="No space left"):
        run(configuration(path, out))
    assert out.exists() == (failing != LISTING)
    monkeypatch.undo()
    assert run(configuration(path, out), resume=True).name == "toy"


@pytest.mark.parametrize("mode", ["new", "resume"])
def test_a_directory_is_named_as_it_was_given(tmp_path, monkeypatch, mode):
    """The message about a relative path gave an absolute one."""
    monkeypatch.chdir(tmp_path)
    Path("out").mkdir()
    Path("out/mine.txt").touch()
    words = "not empty, and not of a run; the directory out_2 keeps both" if mode == "new" else "holds no run"
    with pytest.raises(OutputError, match=f"^out: {words}$"), RunDirectory.open("out", mode):
        pass


def test_resume_needs_a_run_or_nothing(tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("mine")
    with pytest.raises(OutputError, match="holds no run"):
        run(configuration(write_toy(tmp_path), tmp_path / "mine"), resume=True)


def test_the_directory_is_there_before_the_model_is(tmp_path, monkeypatch):
    """What follows may compile for a minute. Data that cannot be used leave nothing, as before."""
    path, out = write_toy(tmp_path), tmp_path / "runs" / "run"

    def looks(*_):
        assert (out / rundir.LISTING).exists()
        raise DataError("unusable")

    monkeypatch.setattr("en4dvar.runs.runner.checked_problem", looks)
    with pytest.raises(DataError, match="unusable"):
        run(configuration(path, out))
    assert not out.exists()
    monkeypatch.undo()
    run(configuration(path, out))
    before = contents(out)
    monkeypatch.setattr("en4dvar.runs.runner.checked_problem", lambda *_: looks())
    with pytest.raises(DataError, match="unusable"):
        run(configuration(path, out), force=True)
    assert contents(out) == before


@pytest.mark.fault("chdir")
@pytest.mark.parametrize("at_import", [False, True])
def test_a_model_that_leaves_the_folder(tmp_path, monkeypatch, at_import):
    """A relative --out stays where it was when the command was given."""
    folder = tmp_path / "here"
    folder.mkdir()
    (tmp_path / "there").mkdir()
    leave = f"import os; os.chdir({str(tmp_path / 'there')!r})"
    (tmp_path / f"leaving{at_import}.py").write_text(
        "from toy_models import Oscillator\n"
        + (f"{leave}\n" if at_import else "")
        + f"class Leaves(Oscillator):\n    def step(self, *a, **k):\n        {leave}\n"
        "        return super().step(*a, **k)\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    path = write_toy(folder, ("toy_models:Oscillator", f"leaving{at_import}:Leaves"))
    monkeypatch.chdir(folder)
    words = ["run", str(path), "--out", "run", "--no-report", "--set", "execution.executor=serial"]
    done = CliRunner().invoke(main, words)
    assert done.exit_code == 0, done.stderr
    assert (folder / "run" / "posterior.nc").is_file()
    assert not list((tmp_path / "there").iterdir())


def test_the_page_names_the_data_as_the_configuration_does_and_the_command_the_page_as_it_was_asked(
    tmp_path, monkeypatch
):
    """Pages are shared: each told where on the machine the data lie."""
    (tmp_path / "private" / "here").mkdir(parents=True)
    write_toy(tmp_path / "private")
    monkeypatch.chdir(tmp_path)
    assert CliRunner().invoke(main, ["run", "private/toy.yaml", "--out", "private/here/run"]).exit_code == 0
    told = CliRunner().invoke(main, ["report", "private/here/run"])
    assert told.stdout == "report: private/here/run/report.html\n"
    page = (tmp_path / "private" / "here" / "run" / "report.html").read_text(encoding="utf-8")
    assert "<tr><td>data source</td><td>toy.csv</td></tr>" in page
    assert str(tmp_path) not in page
    assert rerun("private/here/run").same
