"""How much a population estimate computes."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Effort:
    """Stage 1: ``walkers``, ``rounds`` and ``degree``, and how often emulators see their own posterior (``refits``);
    ``components`` of the mixtures; ``hyper_`` ones of the proposal; ``draws`` weighed with emulators and ``exact`` with
    forward runs, ``effective`` ones wanted of either; how often, at most, an interim prior is tried (``passes``).
    """

    walkers: int = 16
    rounds: int = 200
    degree: int = 4
    refits: int = 3
    components: int = 12
    hyper_walkers: int = 64
    hyper_rounds: int = 60
    hyper_components: int = 6
    draws: int = 3000
    exact: int = 1000
    effective: float = 300.0
    passes: int = 3
