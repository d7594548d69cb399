"""How far to go along a direction. Every rule judges by J of the central trajectory and none accepts a rise.

``cost_of`` maps weights (B, N) to J (B,), +inf where the model fails; candidates come as a batch, so that a model that
integrates many members at once pays for one run.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from en4dvar.schemes import Step
from en4dvar.state import Array

CostOf = Callable[[Array], Array]
SUFFICIENT = 1e-4  # Armijo's constant: the fraction of the predicted decrease that must be realised
BATCH = 4  # trials per call of the model


@dataclass(frozen=True)
class Move:
    """An accepted move: new weights ``w`` (N,), their cost, and the length relative to the full step."""

    w: Array
    cost: float
    step_length: float


StepControl = Callable[[Array, float, Step, CostOf], Move | None]


def full_step(w: Array, cost: float, step: Step, cost_of: CostOf) -> Move | None:
    """The whole step, or None where it raises J."""
    return _best(w, cost, [(1.0, step.direction)], step, cost_of, sufficient=0.0)


def line_search(w: Array, cost: float, step: Step, cost_of: CostOf) -> Move | None:
    """Backtracking: the lowest J among 1, ½, ¼, ⅛ of the step that satisfies Armijo's condition, then shorter ones.

    Returns None when none of 12 halvings lowers J. Source: Nocedal & Wright (2006), Numerical Optimization, § 3.1.
    """
    for first in range(0, 3 * BATCH, BATCH):
        lengths = [0.5**k for k in range(first, first + BATCH)]
        move = _best(w, cost, [(a, a * step.direction) for a in lengths], step, cost_of)
        if move is not None:
            return move
    return None


def levenberg_marquardt(w: Array, cost: float, step: Step, cost_of: CostOf) -> Move | None:
    """−(A + λ(N−1)I)⁻¹ g: the lowest J over λ = 0, 1, 10, 100 that decreases J enough, then over λ = 10³…10¹⁰.

    λ is relative to the prior precision. ``step_length`` is the length of the damped step relative to the undamped one.
    """
    full = float(np.linalg.norm(step.direction)) or 1.0
    for exponents in ((-np.inf, 0, 1, 2), (3, 4, 5, 6), (7, 8, 9, 10)):
        damped = [-step.hessian.solve(step.gradient, damping=10.0**e) for e in exponents]
        move = _best(w, cost, [(float(np.linalg.norm(d)) / full, d) for d in damped], step, cost_of)
        if move is not None:
            return move
    return None


STEP_CONTROLS: dict[str, StepControl] = {
    "full": full_step,
    "line-search": line_search,
    "levenberg-marquardt": levenberg_marquardt,
}


def _best(
    w: Array,
    cost: float,
    trials: list[tuple[float, Array]],
    step: Step,
    cost_of: CostOf,
    sufficient: float = SUFFICIENT,
) -> Move | None:
    candidates = np.stack([w + delta for _, delta in trials])
    costs = cost_of(candidates)
    allowed = [cost + sufficient * min(0.0, float(step.gradient @ delta)) for _, delta in trials]
    passed = np.isfinite(costs) & (costs <= np.array(allowed))
    if not passed.any():
        return None
    best = int(np.argmin(np.where(passed, costs, np.inf)))
    return Move(candidates[best], float(costs[best]), trials[best][0])
