"""What the packaging declares agrees with itself, with the README and with .ci/run."""

from __future__ import annotations

import re
import tomllib
from importlib.metadata import version
from pathlib import Path

import yaml

import en4dvar

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
CI = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
README = (ROOT / "README.md").read_text(encoding="utf-8")


def test_there_is_one_version():
    """Of the installation, the changelog's newest release and the citation, which also share a date."""
    stated = PROJECT["project"]["version"]
    assert en4dvar.__version__ == version("en4dvar") == stated
    (named, date), *_ = re.findall(
        r"^## \[([\d.]+)\] – (.*)$", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.M
    )
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert named == cited["version"] == stated
    assert date == str(cited["date-released"])


def test_python_versions_agree():
    declared = re.findall(r"Python :: (3\.\d+)", "\n".join(PROJECT["project"]["classifiers"]))
    lowest = min(declared, key=lambda v: int(v.partition(".")[2]))
    assert PROJECT["project"]["requires-python"] == f">={lowest}"
    assert PROJECT["tool"]["mypy"]["python_version"] == lowest


def test_ci_types_the_two_commands_of_the_readme():
    commands = re.findall(r"^python3 -m venv \.venv && (.*)$", README, re.M)
    assert [".venv/bin/en4dvar run" in c for c in commands] == [True, False]
    assert ["pytest -n auto" in c for c in commands] == [False, True]
    assert "grep '^python3 -m venv .venv && ' README.md" in CI


def test_nobody_is_told_to_install_en4dvar_from_an_index():
    """It is on none: what is installed under this name is a stranger's. Extras are installed from the clone."""
    pages = [ROOT / "README.md", *ROOT.glob("docs/*.md"), *ROOT.glob("benchmarks/*.py")]
    texts = [
        p.read_text(encoding="utf-8") for p in [*pages, *ROOT.glob("en4dvar/**/*.py"), *ROOT.glob("models/**/*.py")]
    ]
    assert [t for t in texts if re.search(r"install (?:-\w+ )*'?en4dvar", t)] == []
    groups = [group for t in texts for group in re.findall(r"install (?:-\w+ )*'\.\[([\w,]+)\]'", t)]
    named = {extra for group in groups for extra in group.split(",")}
    assert {"dev", "docs", "distributed", "movie"} <= named <= set(PROJECT["project"]["optional-dependencies"])


def test_the_lock_file_is_of_these_requirements():
    """``uv lock`` was run after the last change of a requirement."""
    lock = tomllib.loads((ROOT / "uv.lock").read_text(encoding="utf-8"))
    assert lock["requires-python"] == PROJECT["project"]["requires-python"]
    (own,) = (p for p in lock["package"] if p["name"] == "en4dvar")
    locked = {
        (r["name"], r.get("specifier", ""), tuple(sorted(r.get("extras", ()))), r.get("marker", ""))
        for r in own["metadata"]["requires-dist"]
    }
    wanted = {(*_parsed(text), "") for text in PROJECT["project"]["dependencies"]}
    for extra, texts in PROJECT["project"]["optional-dependencies"].items():
        wanted |= {(*_parsed(text), f"extra == '{extra}'") for text in texts}
    assert locked == wanted


def _parsed(text: str) -> tuple[str, str, tuple[str, ...]]:
    """Name, specifier and extras of a requirement, as the lock file writes them."""
    name, extras, specifier = re.fullmatch(r"([\w.-]+)(?:\[([\w,-]+)\])?\s*(.*)", text).groups()
    return name.lower().replace("_", "-"), specifier, tuple(sorted(extras.split(","))) if extras else ()
