"""How the variables of each series are called in a file.

A data set of one observable has the dimension ``time``, and its weights are ``weights``. Of several series each has a
dimension of its own, ``<name>_time``, and ``<name>_weights``. So the groups stay those of ArviZ: a variable of the
observed data has the same name and dimension in the predictions and in the log-likelihood.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Axis:
    """Of the series ``name``; ``alone``: it is the only one."""

    name: str
    alone: bool = True

    @property
    def time(self) -> str:
        """Dimension, and coordinate, of its readings."""
        return self.own("time")

    def own(self, what: str) -> str:
        """A variable that a file of a single observable has once."""
        return what if self.alone else f"{self.name}_{what}"


def axes_of(names: Sequence[str]) -> tuple[Axis, ...]:
    """Of the series of a data set."""
    return tuple(Axis(name, len(names) == 1) for name in names)
