"""A result file of a stranger names code: nothing of it runs before the user has agreed."""

import hashlib
import os
import pty
import shutil
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import pytest
from click.testing import CliRunner
from rows import row
from run_files import command, configuration, environment
from toy_config import write_toy

from en4dvar.cli import main
from en4dvar.config import load_config
from en4dvar.plumbing import user_code
from en4dvar.plumbing.user_code import Code, RefusedError
from en4dvar.report.result import load_result
from en4dvar.runs import trust
from en4dvar.runs.rerun import rerun
from en4dvar.runs.runner import run
from en4dvar.runs.trust import of_strangers
from en4dvar_bubble.laws.loading import get_law

MODEL = """\
from pathlib import Path
from toy_models import Oscillator
Path(__file__).with_name("has run").touch()
class Model(Oscillator):
    "As the oscillator."
"""
LAW = """\
from pathlib import Path
Path(__file__).with_name("has run").touch()
"""


@contextmanager
def state_of(folder):
    """Within, this process is that of a user with another home."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_STATE_HOME", str(folder))
        yield


@pytest.fixture
def project(tmp_path, monkeypatch):
    """A run whose model lies beside the project, on the path of modules."""
    there, folder = tmp_path / "elsewhere", tmp_path / "project"
    there.mkdir()
    folder.mkdir()
    (there / "strange_model.py").write_text(MODEL)
    monkeypatch.syspath_prepend(there)
    monkeypatch.chdir(folder)
    path = write_toy(folder, ("toy_models:Oscillator", "strange_model:Model"))
    with state_of(tmp_path / "somebody"):  # who has run it is not who reads the result
        run(configuration(path, folder / "run", executor="serial"))
    forget(there / "has run")
    return folder, there / "has run"


def forget(mark):
    mark.unlink()
    del sys.modules["strange_model"]


def again(project, **more):
    """``en4dvar rerun``, in a process of its own."""
    folder, mark = project
    modules = os.pathsep.join([environment()["PYTHONPATH"], str(mark.parent)])
    return subprocess.run(
        command("rerun", folder / "run"),
        capture_output=True, text=True, env=environment() | {"PYTHONPATH": modules}, **more,
    )  # fmt: skip


@pytest.mark.slow
@pytest.mark.fault("rerun-stranger")
def test_code_from_elsewhere_is_refused_and_can_be_trusted(project):
    folder, mark = project
    refused = again(project, stdin=subprocess.DEVNULL)
    assert (refused.returncode, refused.stdout) == (2, "")
    assert refused.stderr == (
        f"{folder}/run: its model 'strange_model:Model' is code that no configuration of yours has named as it is now, "
        f"{mark.parent}/strange_model.py; read it, then give --trust to run it\n"
    )
    assert row("rerun-stranger").told(refused.stderr)
    assert not mark.exists()
    assert rerun(folder / "run", trust=True).same
    assert mark.exists()
    forget(mark)


@pytest.mark.fault("rerun-stranger")
def test_the_user_is_asked_once(project):
    folder, mark = project
    for answer in (False, True):
        asked: list[str] = []

        def ask(question, asked=asked, answer=answer):
            asked.append(question)
            assert not mark.exists()
            return answer

        if answer:
            assert rerun(folder / "run", ask=ask).same
        else:
            with pytest.raises(RefusedError):
                rerun(folder / "run", ask=ask)
        assert mark.exists() == answer
        (question,) = asked
        assert question.endswith(f"as it is now, {mark.parent}/strange_model.py; run it?")
    forget(mark)


@pytest.mark.parametrize(("answer", "code"), [("y", 0), ("n", 2), ("", 2)])
@pytest.mark.slow
def test_at_a_terminal(project, answer, code):
    ours, theirs = pty.openpty()
    os.write(ours, f"{answer}\n".encode())
    done = again(project, stdin=theirs)
    os.close(ours)
    os.close(theirs)
    assert done.returncode == code, done.stderr
    assert done.stderr.count("elsewhere/strange_model.py; run it? [y/N]") == 1
    assert project[1].exists() == (code == 0)


@pytest.mark.fault("rerun-stranger")
def test_code_that_a_configuration_of_the_user_has_named_runs_as_ever(project, monkeypatch):
    """Until it is another one; where it lies says nothing, for a stranger's archive is unpacked here, too."""
    folder, mark = project
    monkeypatch.chdir(folder.parent)
    with pytest.raises(RefusedError):
        rerun(folder / "run")
    load_config(folder / "toy.yaml")
    forget(mark)
    assert rerun(folder / "run").same
    forget(mark)
    law = mark.parent / "strange_model.py"
    law.write_text(law.read_text() + "# another line\n")
    with pytest.raises(RefusedError):
        rerun(folder / "run")
    assert not mark.exists()


@pytest.fixture
def sealed(tmp_path):
    """A run whose file was changed and sealed again, to name a law; and where that law lies."""
    run(configuration(write_toy(tmp_path), tmp_path / "theirs" / "run", executor="serial"))
    law = tmp_path / "theirs" / "law.py"
    law.write_text(LAW)

    def name(path):
        text = f"name: x\nmodel: {{name: bubble, law: '{path}:Law'}}\nparameters: {{}}\n"
        file = tmp_path / "theirs" / "run" / "posterior.nc"
        load_result(file).with_attributes("/", configuration_resolved=text).save(file)
        return file.parent, law

    return name


@pytest.mark.parametrize(
    "path",
    ["../law.py", "{folder}/law.py", "{link}/law.py", "/proc/self/cwd/../theirs/law.py", "/proc/self/cwd/law.py"],
)
@pytest.mark.fault("rerun-stranger")
def test_a_law_of_a_strangers_file(sealed, tmp_path, monkeypatch, path):
    """A relative path is nobody's of this project, wherever the run was unpacked; a link leads where it leads."""
    here = tmp_path / "here"
    here.mkdir()
    (here / "link").symlink_to(tmp_path / "theirs")
    run_dir, law = sealed(path.format(folder=tmp_path / "theirs", link=here / "link"))
    monkeypatch.chdir(law.parent if path == "/proc/self/cwd/law.py" else tmp_path if path == "../law.py" else here)
    told = r"its law '.*law.py:Law' is code that no configuration of yours has named as it is now, .*/theirs/law\.py"
    with pytest.raises(RefusedError, match=told):
        rerun(run_dir)
    for verb in ("population", "joint", "compare"):
        done = CliRunner().invoke(main, [verb, str(run_dir), str(run_dir)])
        assert done.exit_code == 2 or verb == "compare"
    assert not law.with_name("has run").exists()
    assert CliRunner().invoke(main, ["export", str(run_dir)]).exit_code == 0
    assert not law.with_name("has run").exists()
    with pytest.raises(Exception, match="no class 'Law'"):
        rerun(run_dir, trust=True)
    assert law.with_name("has run").exists()


def test_installed_code_is_known(tmp_path, monkeypatch):
    """The standard library, packages, and this one, which is installed to be edited."""
    monkeypatch.chdir(tmp_path)
    trust._edited.cache_clear()
    with of_strangers(tmp_path, None, False):
        assert get_law("quadratic-kelvin-voigt").name == "quadratic-kelvin-voigt"
        assert get_law("en4dvar_bubble.laws.kelvin_voigt:NeoHookeanKelvinVoigt").title
    assert trust._is_known(user_code._code_of("", "pytest"))
    assert not trust._is_known(Code("", (Path(pytest.__file__),), digest="0"))  # not as a package, but by its path


@pytest.mark.parametrize("name", ["stranger.evil:Law", "en4dvar.plumbing.user_file.{path}_{digest}:Law"])
def test_a_stranger_reaches_no_folder_through_the_name_of_a_module(sealed, tmp_path, monkeypatch, name):
    """A folder on the path of modules, as the root of a project that is installed to be edited, is no package."""
    run_dir, law = sealed("nothing")
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "stranger").mkdir()
    evil = Path(shutil.copy(law, tmp_path / "stranger" / "evil.py"))
    name = name.format(path=str(law).encode().hex(), digest=hashlib.sha256(law.read_bytes()).hexdigest())
    monkeypatch.setattr(trust, "_edited", lambda: {"en4dvar": (tmp_path,)})
    text = f"name: x\nmodel: {{name: bubble, law: '{name}'}}\nparameters: {{}}\n"
    file = run_dir / "posterior.nc"
    load_result(file).with_attributes("/", configuration_resolved=text).save(file)
    with pytest.raises(Exception, match="no configuration of yours has named"):
        rerun(run_dir)
    assert not any(file.with_name("has run").exists() for file in (evil, law))
