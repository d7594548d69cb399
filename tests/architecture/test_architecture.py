"""What the layout promises: the framework knows no application, files stay short, all is packaged, imports light."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
import tomllib
from fnmatch import fnmatch
from importlib import import_module
from importlib.metadata import distribution
from pathlib import Path

import pytest
from syntax import nodes

ROOT = Path(__file__).resolve().parents[2]
SOURCES = sorted(p for top in ("en4dvar", "models", "tests", "benchmarks") for p in (ROOT / top).rglob("*.py"))
FRAMEWORK = sorted((ROOT / "en4dvar").rglob("*.py"))
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
HEAVY = ("numba", "xarray", "matplotlib", "scipy", "pydantic", "pandas", "netCDF4", "jinja2")


def imported_modules(source: str) -> set[str]:
    """Every module that a file imports, at any depth of nesting, also by ``import_module("…")``."""
    names = set()
    for node in nodes(source):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names |= {node.module or ""} | {f"{node.module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Call) and getattr(node.func, "attr", getattr(node.func, "id", "")) in (
            "import_module",
            "__import__",
        ):
            names |= {a.value for a in node.args if isinstance(a, ast.Constant) and isinstance(a.value, str)}
    return names


def applications(source: str) -> set[str]:
    return {name for name in imported_modules(source) if name.split(".")[0].startswith("en4dvar_")}


def test_framework_imports_no_application():
    assert len(FRAMEWORK) > 50
    found = {str(p.relative_to(ROOT)): applications(p.read_text(encoding="utf-8")) for p in FRAMEWORK}
    assert {path: names for path, names in found.items() if names} == {}


@pytest.mark.parametrize(
    "source",
    ["import en4dvar_bubble", "from en4dvar_bubble.laws import X", "def f():\n    import en4dvar_lorenz as m",
     "import importlib\nimportlib.import_module('en4dvar_bubble')"],
)  # fmt: skip
def test_an_application_import_would_be_seen(source):
    assert applications(source)


def test_files_stay_below_500_lines():
    long = {
        str(p.relative_to(ROOT)): n for p in SOURCES if (n := len(p.read_text(encoding="utf-8").splitlines())) > 500
    }
    assert long == {}


def test_every_package_of_both_roots_is_packaged():
    find = PROJECT["tool"]["setuptools"]["packages"]["find"]
    assert find["where"] == [".", "models"]
    folders = {p.parent for root in ("en4dvar", "models") for p in (ROOT / root).rglob("*.py")}
    assert {ROOT / "en4dvar", ROOT / "models" / "en4dvar_bubble"} <= folders
    # setuptools leaves a folder without __init__.py out of the wheel, and every name must match the include patterns
    assert [str(f) for f in folders if not (f / "__init__.py").is_file()] == []
    tops = {f.relative_to(ROOT).parts[0 if f.is_relative_to(ROOT / "en4dvar") else 1] for f in folders}
    assert [t for t in tops if not any(fnmatch(t, pattern) for pattern in find["include"])] == []


def test_files_beside_the_code_are_packaged():
    patterns = PROJECT["tool"]["setuptools"]["package-data"]["*"]
    beside = [
        p
        for root in ("en4dvar", "models")
        for p in (ROOT / root).rglob("*")
        if p.is_file() and p.suffix != ".py" and "__pycache__" not in p.parts and "egg-info" not in str(p)
    ]
    assert [p.name for p in beside if not any(p.match(pattern) for pattern in patterns)] == []


def test_every_entry_point_leads_somewhere():
    groups = [PROJECT["project"]["scripts"], *PROJECT["project"]["entry-points"].values()]
    declared = {name: value for group in groups for name, value in group.items()}
    assert set(declared) == {e.name for e in distribution("en4dvar").entry_points}, "install the project again"
    for value in declared.values():
        module, _, attribute = value.partition(":")
        assert callable(getattr(import_module(module), attribute)), value


@pytest.mark.parametrize("code", ["import en4dvar", "import en4dvar.cli"])
def test_import_is_light(code):
    probe = f"{code}\nimport sys\nprint(*(m for m in {HEAVY!r} if m in sys.modules))"
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, "-c", probe], capture_output=True, text=True, env=environment, check=True)
    assert done.stdout.split() == []


def test_lock_file_names_no_private_index():
    addresses = {
        piece.split('"')[0]
        for line in (ROOT / "uv.lock").read_text(encoding="utf-8").splitlines()
        for piece in line.split('= "')[1:]
        if "://" in piece
    }
    assert addresses
    hosts = ("https://pypi.org/simple", "https://files.pythonhosted.org/")
    assert {a for a in addresses if not a.startswith(hosts)} == set()


def test_public_names_exist_for_people_and_for_type_checkers():
    package = import_module("en4dvar")
    public = {name for name in dir(package) if not name.startswith("_")}
    assert "run" in public
    for name in public:
        assert getattr(package, name) is not None
    stub = ast.parse((ROOT / "en4dvar" / "__init__.pyi").read_text(encoding="utf-8"))
    assert {alias.asname for node in stub.body if isinstance(node, ast.ImportFrom) for alias in node.names} == public
