"""There is one loop: whatever is minimised is an objective of it."""

from __future__ import annotations

import ast
import inspect
from pathlib import Path

import pytest

from en4dvar.descent import field, loop, start, window
from en4dvar.estimation.joint import descent as joint
from en4dvar.series import window as cycle

OBJECTIVES = {
    window.DataWindow, start.Rounds, field.Passes, field.FieldObjective, joint.JointObjective, cycle.CycleWindow,
}  # fmt: skip


def every(kind: type) -> set[type]:
    return {kind}.union(*map(every, kind.__subclasses__()))


def test_everything_that_is_minimised_is_an_objective() -> None:
    assert every(loop.Objective) - {loop.Objective} == OBJECTIVES


@pytest.mark.parametrize(
    "objective", sorted(OBJECTIVES, key=lambda kind: kind.__name__), ids=lambda kind: kind.__name__
)
def test_no_objective_iterates_by_itself(objective: type) -> None:
    """It linearises, judges, searches and moves once when it is asked; trial steps of a search are a generator's."""
    (source,) = ast.parse(inspect.getsource(objective)).body
    assert not [node for node in ast.walk(source) if isinstance(node, ast.While)]
    asked = {"linearise", "judge", "search", "move"}
    own = [node for node in source.body if isinstance(node, ast.FunctionDef) and node.name in asked]
    called = {ast.unparse(node.func) for method in own for node in ast.walk(method) if isinstance(node, ast.Call)}
    assert own
    assert not called & {f"self.{name}" for name in asked}


def test_an_iteration_is_one_screenful() -> None:
    assert len(inspect.getsource(loop.minimise).splitlines()) < 15
    assert len(Path(loop.__file__).read_text(encoding="utf-8").splitlines()) < 100
