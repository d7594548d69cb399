"""How much a population estimate computes."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Effort:
    """``hyper_`` walkers, their rounds, and components of the proposal fitted to them; ``draws`` of it that are
    weighed, ``effective`` ones wanted.
    """

    hyper_walkers: int = 64
    hyper_rounds: int = 60
    hyper_components: int = 6
    draws: int = 3000
    effective: float = 300.0
