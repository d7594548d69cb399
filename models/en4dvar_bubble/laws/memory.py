"""Memory variables: stresses that relax."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from en4dvar.state import Array

Source = float | Array | Callable[[Array], Array]


@dataclass(frozen=True)
class MemoryVariable:
    """A stress s (Pa) that adds to J, with ds/dt = −s/θ + k V s + V a(λ) + b(λ)/θ, V = Ṙ/R.

    Attributes
    ----------
    relaxation_time: θ in s, number or (N, 1).
    convection: k, a number.
    stiffness: a(λ) in Pa: a number, (N, 1), or a function of the stretch (K,) → (N, K).
    equilibrium: b(λ) in Pa, likewise: the value of s at rest.
    """

    relaxation_time: float | Array
    convection: float = 0.0
    stiffness: Source = 0.0
    equilibrium: Source = 0.0


class MemoryTables(NamedTuple):
    """The memory variables of N members as the compiled solver takes them; tables on the grid of ln λ."""

    relaxation_time: Array
    """θ (N, M) in s."""
    convection: Array
    """k (M,)."""
    stiffness: Array
    """a (N, M, cells, 8) in Pa."""
    equilibrium: Array
    """b (N, M, cells, 8) in Pa."""
