"""How a regression over the ensemble ends: where its own gradient vanishes, by damped steps.

That gradient is the one of J averaged over the ensemble, as Stein's identity has it of Gaussian members. It need not
vanish where J of the central run is smallest, so that close to there J cannot judge the steps any more: a search by J
stops with steps left. The length of the next step, in posterior standard deviations, can. Steps and ensemble may also
drive each other to and fro; then the transform of the ensemble is held, and the steps are damped.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

NEAR = 0.5  # posterior standard deviations: a regression whose steps are shorter settles; longer ones are searched by J
LEAST = 1 / 32  # share of a step


@dataclass(frozen=True)
class Settling:
    """``share`` of the next step that is taken, and length of the step ``before``; ``held``: the transform stays."""

    share: float = 1.0
    before: float = math.inf
    held: bool = False

    def after(self, norm: float) -> Settling:
        """With a next step of length ``norm``.

        Where a share s of the steps is taken, these should shrink by s of their length; half as much is asked for. At
        the first step that does not shrink like that the transform is held, at each later one the share is halved.
        """
        if norm <= (1 - 0.5 * self.share) * self.before:
            return Settling(self.share, norm, self.held)
        return Settling(max(0.5 * self.share, LEAST) if self.held else self.share, norm, held=True)
