"""A scheme sees weights and whitened arrays: no state, no model, no observations, no truth."""

import ast
import inspect
from pathlib import Path

import pytest

import en4dvar.schemes
from en4dvar.schemes.base import Scheme

ALLOWED = {
    "en4dvar.ensemble.linalg", "en4dvar.model.state", "en4dvar.plumbing.installed", "en4dvar.plumbing.errors",
    "en4dvar.plumbing.hints", "en4dvar.plumbing.user_code",
}  # fmt: skip
FILES = sorted(p for p in Path(en4dvar.schemes.__file__).parent.glob("*.py") if p.stem != "settings")


def test_signature_of_a_scheme():
    arguments = {
        name: tuple(inspect.signature(method).parameters)[1:]
        for name, method in vars(Scheme).items()
        if inspect.isfunction(method) and not name.startswith("_")
    }
    assert arguments == {
        "members": ("weights", "basis"),
        "linearise": ("weights", "runs"),
        "advance": ("weights", "evaluation", "iteration", "draw"),
        "done": ("iteration", "step"),
        "left": ("step",),
    }


@pytest.mark.parametrize("file", FILES, ids=lambda f: f.stem)
def test_schemes_import_no_model_and_no_data(file):
    imported = {node.module for node in ast.walk(ast.parse(file.read_text())) if isinstance(node, ast.ImportFrom)}
    framework = {module for module in imported if module and module.startswith("en4dvar")}
    assert {module for module in framework if not module.startswith("en4dvar.schemes")} <= ALLOWED
