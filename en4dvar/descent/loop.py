"""The only loop: forecast → linearise → whiten → step → step control, until every descent has ended.

What it goes through is a *window*: one data set with parameters to estimate (:mod:`en4dvar.descent.window`), or one
cycle of a series (:mod:`en4dvar.cycling.sequential`). What is computed is the scheme's.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, TypeVar

from en4dvar.schemes.base import Evaluation, GaussNewtonStep, Runs, Scheme, Step, Weights
from en4dvar.state import Array


class Descends(Protocol):
    """What the loop needs of a descent: where it stands, the step from there, and whether it has ended."""

    weights: Weights
    step: Step | GaussNewtonStep | None
    ended: bool

    @property
    def iteration(self) -> int: ...


D = TypeVar("D", bound=Descends, contravariant=True)


class Window(Protocol[D]):
    """What the loop needs of a window."""

    def begin(self, going: Sequence[D]) -> None:
        """Called before each iteration: keep what an interrupted run needs."""

    def run(self, scheme: Scheme, going: Sequence[D]) -> list[Runs | None]:
        """The scheme's members through F and H, all descents in one call; None where too few of them survive."""

    def whiten(self, scheme: Scheme, descent: D, reference: Array, anomalies: Array) -> Evaluation:
        """R^{-1/2} applied to a linearisation."""

    def draw(self, purpose: str, columns: int | None = None) -> Array:
        """Random numbers for a scheme, see :class:`~en4dvar.schemes.base.Draw`."""

    def move(self, scheme: Scheme, going: Sequence[D]) -> None:
        """Take the steps, as far as they go; record, tell, and end the descents that are done."""


def iterate(window: Window[D], scheme: Scheme, descents: Sequence[D]) -> None:
    """Iterate descents side by side, usually one, until each has ended."""
    while going := [descent for descent in descents if not descent.ended]:
        window.begin(going)
        for descent, runs in zip(going, window.run(scheme, going), strict=True):
            descent.step = None
            if runs is not None:
                reference, anomalies = scheme.linearise(descent.weights, runs)
                evaluation = window.whiten(scheme, descent, reference, anomalies)
                descent.step = scheme.advance(descent.weights, evaluation, descent.iteration, window.draw)
        window.move(scheme, going)
