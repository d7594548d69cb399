"""What a user gets: sdist and wheel are built, the wheel is installed in a fresh environment and used far from here.

Needs the package index; run by .ci/run. ``pytest tests/packaging -m long``
"""

from __future__ import annotations

import email
import shutil
import subprocess
import sys
import tarfile
import venv
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
pytestmark = [pytest.mark.slow, pytest.mark.long]


def call(*words: object, folder: Path) -> str:
    """Standard output of a command that must succeed, without this repository on any path."""
    done = subprocess.run([str(w) for w in words], cwd=folder, stdin=subprocess.DEVNULL, capture_output=True, text=True)
    assert done.returncode == 0, f"{words}: exit code {done.returncode}\n{done.stdout}{done.stderr}"
    return done.stdout


def made_here(folder: str, names: list[str]) -> list[str]:
    """What is no part of the project: outputs, environments, caches."""
    outputs = {"runs", "site", "build", "dist", "venv", ".venv"} if Path(folder) == ROOT else set()
    return [n for n in names if n in outputs or n == "__pycache__" or n.endswith((".egg-info", "_cache"))]


@pytest.fixture(scope="module")
def built(tmp_path_factory) -> dict[str, Path]:
    """The sdist made from the tree, and the wheel made from the sdist.

    Of a copy: making an sdist puts a tree of its own into this one for a while, in which other tests would look around.
    """
    folder, tree = tmp_path_factory.mktemp("dist"), tmp_path_factory.mktemp("copy") / "tree"
    shutil.copytree(ROOT, tree, ignore=made_here)
    call(sys.executable, "-m", "build", "--outdir", folder, tree, folder=folder)
    (wheel,), (sdist,) = folder.glob("*.whl"), folder.glob("*.tar.gz")
    return {"wheel": wheel, "sdist": sdist}


@pytest.fixture(scope="module")
def installed(built, tmp_path_factory) -> Path:
    """The ``bin`` of a fresh environment that holds the wheel and what it requires."""
    folder = tmp_path_factory.mktemp("user")
    venv.create(folder / "venv", with_pip=True)
    programs = folder / "venv" / "bin"
    words = ("install", "-q", "--disable-pip-version-check", "--no-compile")  # bytecode of what is imported is enough
    call(programs / "pip", *words, built["wheel"], folder=folder)
    return programs


def test_the_wheel_holds_the_packages_and_what_lies_beside_them(built):
    with zipfile.ZipFile(built["wheel"]) as wheel:
        names = wheel.namelist()
        metadata = email.message_from_bytes(wheel.read(next(n for n in names if n.endswith("/METADATA"))))
    tops = {name.partition("/")[0] for name in names}
    info = {top for top in tops if top.endswith(".dist-info")}
    assert tops - info == {"en4dvar", *(p.parent.name for p in (ROOT / "models").glob("*/__init__.py"))}
    assert {"en4dvar_agarose", "en4dvar_bubble", "en4dvar_lorenz"} <= tops
    for package, root in (("en4dvar", ROOT), ("en4dvar_*", ROOT / "models")):
        here = {p.relative_to(root).as_posix() for p in root.glob(f"{package}/**/*") if p.is_file()}
        made = {name for name in here if "__pycache__" in name or "egg-info" in name}
        assert here - made - set(names) == set()
    assert {"en4dvar/py.typed", "en4dvar_bubble/py.typed"} <= set(names)
    assert metadata["Requires-Python"] == ">=3.11"
    assert metadata["License-Expression"] == "BSD-3-Clause"
    assert {"distributed", "docs", "dev"} <= set(metadata.get_all("Provides-Extra") or ())
    assert metadata["Version"] in built["wheel"].name


def test_the_sdist_can_be_tested_and_documented(built):
    with tarfile.open(built["sdist"]) as sdist:
        names = {name.partition("/")[2] for name in sdist.getnames()}
    assert {"pyproject.toml", "LICENSE", "README.md", "mkdocs.yml", "tests/conftest.py"} <= names
    assert {"docs/index.md", "configs/quickstart.yaml", "configs/data/agarose_synthetic.csv"} <= names
    assert not [name for name in names if name.startswith("shared/") or name.endswith((".nbi", ".nbc", ".pyc"))]


def test_the_quick_start_runs_from_the_wheel_alone(installed, tmp_path):
    call(installed / "en4dvar", "init", "--example", "quickstart", folder=tmp_path)
    call(installed / "en4dvar", "run", "quickstart.yaml", folder=tmp_path)
    run = tmp_path / "runs" / "quickstart"
    for name in ("posterior.nc", "report.html", "summary.csv"):
        assert (run / name).stat().st_size > 0
    where = call(installed / "python", "-c", "import en4dvar; print(en4dvar.__file__)", folder=tmp_path)
    assert Path(where.strip()).is_relative_to(installed.parent)


def test_the_extras_install_and_import(installed, built, tmp_path):
    wanted = f"en4dvar[distributed] @ {built['wheel'].as_uri()}"
    call(installed / "pip", "install", "-q", "--disable-pip-version-check", wanted, folder=tmp_path)
    call(installed / "python", "-c", "import dask, distributed, en4dvar.executor.dask", folder=tmp_path)
