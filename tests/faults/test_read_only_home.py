"""Program and HOME that cannot be written, as on many clusters: everything works, compiled code is kept elsewhere."""

from __future__ import annotations

import compileall
import os
import shutil
import stat
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from rows import row

from en4dvar.plumbing import compiled

ROOT = Path(__file__).resolve().parents[2]
NOBODY = 65534
Run = Callable[..., "subprocess.CompletedProcess[str]"]


def as_a_user() -> list[str]:
    """Words before a command that run it as somebody to whom permissions mean something: root is refused nothing."""
    if os.getuid() != 0:
        return []
    words = ["setpriv", f"--reuid={NOBODY}", f"--regid={NOBODY}", "--clear-groups"]
    if shutil.which("setpriv") is None or subprocess.run([*words, sys.executable, "-c", ""], check=False).returncode:
        pytest.skip("root here, and the interpreter cannot be run as somebody else")
    return words


@pytest.fixture(scope="module")
def closed() -> Iterator[tuple[Path, Run]]:
    """A folder that users can write in, and a runner of ``en4dvar`` from a read-only copy, with a read-only HOME."""
    user = as_a_user()
    here = Path(tempfile.mkdtemp(prefix="en4dvar_closed_"))
    for top in (ROOT / "en4dvar", *(ROOT / "models").glob("en4dvar_*")):
        shutil.copytree(top, here / "code" / top.name, ignore=shutil.ignore_patterns("__pycache__"))
    compileall.compile_dir(here / "code", quiet=1)  # once, not by each of the commands, which can keep nothing there
    (here / "home").mkdir()
    (here / "tmp").mkdir()
    for path in (here, *here.rglob("*")):
        path.chmod(0o555 if path.is_dir() else 0o444)
    (here / "tmp").chmod(0o777 | stat.S_ISVTX)
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("NUMBA", "XDG", "COV"))}
    environment |= {"HOME": str(here / "home"), "TMPDIR": str(here / "tmp"), "PYTHONPATH": str(here / "code")}

    def run(*words: str, **more: str) -> subprocess.CompletedProcess[str]:
        command = [*user, sys.executable, "-m", "en4dvar.cli", *words]
        return subprocess.run(
            command, cwd=here / "tmp", env=environment | more, capture_output=True, text=True, check=False
        )

    yield here, run
    for path in (here, here / "home", *(p for p in (here / "code").rglob("*") if p.is_dir()), here / "code"):
        path.chmod(0o755)
    shutil.rmtree(here)


@pytest.mark.fault("read-only-home")
@pytest.mark.slow
def test_compiled_code_is_kept_in_a_temporary_folder_and_said_so_once(closed: tuple[Path, Run]) -> None:
    here, run = closed
    done = run("laws")
    assert done.returncode == 0, done.stderr
    assert "quadratic-kelvin-voigt" in done.stdout
    assert len(done.stderr.splitlines()) == 1
    assert row("read-only-home").told(done.stderr)
    (kept,) = (here / "tmp").glob("en4dvar-numba-*")
    assert stat.S_IMODE(kept.stat().st_mode) == 0o700
    assert str(kept) in done.stderr


@pytest.mark.slow
def test_a_folder_that_the_user_names_goes_before(closed: tuple[Path, Run]) -> None:
    here, run = closed
    asked = run("laws", NUMBA_CACHE_DIR=str(here / "tmp" / "mine"))
    assert (asked.returncode, asked.stderr) == (0, "")
    wrong = run("laws", NUMBA_CACHE_DIR=str(here / "home" / "mine"))
    assert wrong.returncode == 0
    assert f"NUMBA_CACHE_DIR={here / 'home' / 'mine'} cannot be written" in wrong.stderr


@pytest.mark.slow
def test_a_configuration_is_validated_and_run(closed: tuple[Path, Run]) -> None:
    _, run = closed
    for words in (["models"], ["schema"], ["validate", "{config}"], ["run", "{config}", "--no-report"]):
        # a model that is compiled in a second; a bubble's law takes ten
        done = run(*(word.format(config=ROOT / "configs" / "predator_prey.yaml") for word in words))
        assert done.returncode == 0, done.stderr
        assert done.stderr.count("compiled code is kept in") == 1
        assert "Traceback" not in done.stderr


def test_a_folder_that_others_can_write_is_not_used(tmp_path: Path) -> None:
    """Numba runs what it finds in its cache: nobody may put it there before us, on no detour."""
    name = f"en4dvar-numba-{os.getuid()}"
    own = compiled._own_folder(tmp_path)
    assert own == tmp_path / name == compiled._own_folder(tmp_path)
    own.chmod(0o777)
    assert compiled._own_folder(tmp_path) != own
    own.rmdir()
    (tmp_path / "theirs").mkdir()
    own.symlink_to(tmp_path / "theirs")
    assert compiled._own_folder(tmp_path) != own
    own.unlink()
    own.touch()
    made = compiled._own_folder(tmp_path)
    assert made != own
    assert stat.S_IMODE(made.stat().st_mode) == 0o700


def test_nowhere_at_all_is_one_error(monkeypatch: pytest.MonkeyPatch) -> None:
    def nowhere() -> str:
        raise FileNotFoundError(2, "No usable temporary directory found")

    monkeypatch.setattr(tempfile, "gettempdir", nowhere)
    with pytest.raises(compiled.OutputError, match=r"No usable temporary directory found.*NUMBA_CACHE_DIR"):
        compiled._temporary_folder()
