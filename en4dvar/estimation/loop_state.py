"""Where an assimilation can be interrupted, and all that it needs to go on to the same bits."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from en4dvar.descent.minima import Minimum
from en4dvar.descent.search import SearchState
from en4dvar.descent.start import StartState
from en4dvar.descent.window import Descent
from en4dvar.plumbing.caution import Caution
from en4dvar.sampling.mcmc import ChainState


@dataclass(frozen=True)
class Refinement:
    """A Markov chain under way, and the forward runs up to there."""

    chain: ChainState
    forward_runs: int


@dataclass(frozen=True)
class LoopState:
    """All that the rest of an assimilation depends on, besides the problem, the settings and the seed.

    ``comparison`` is there until the start is chosen; ``descent``, the other ``minima`` that descents ended in and from
    which members these started (``tried``) from then on; ``search`` while further descents look for another minimum,
    ``refinement`` once the Markov chain is under way.
    """

    forward_runs: int
    comparison: StartState | None = None
    descent: Descent | None = None
    minima: tuple[Minimum, ...] = ()
    tried: tuple[int, ...] = ()
    warnings: tuple[Caution, ...] = ()
    search: SearchState | None = None
    refinement: Refinement | None = None

    @property
    def reached(self) -> str:
        """How far it has got, in words."""
        if self.comparison is not None:
            return f"after {self.comparison.rounds} rounds of the start"
        return f"after {self.descent.iteration if self.descent else 0} iterations"


Keep = Callable[[Callable[[], LoopState]], None]
