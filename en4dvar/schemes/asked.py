"""What a scheme is asked, and what it may answer: a mistake in one of the user's own ends in a sentence that names it.

Each function raises :class:`ConfigError` where the method of its name in the scheme fails or gives something else.
"""

import math
from typing import Any

import numpy as np

from en4dvar.model.state import Array
from en4dvar.plumbing.errors import ConfigError, En4dvarError
from en4dvar.plumbing.hints import counted, short
from en4dvar.plumbing.user_code import describe, line_of
from en4dvar.schemes.base import Draw, Evaluation, GaussNewtonStep, Runs, Scheme, Step, Weights

MOST = 1000  # iterations of a scheme that says nothing of how many it takes


def _asked(scheme: Scheme, method: str, *arguments: Any) -> Any:
    """What a method of a scheme gives."""
    try:
        return getattr(scheme, method)(*arguments)
    except Exception as error:
        where, within = line_of(error), error.__traceback__ and error.__traceback__.tb_next
        if isinstance(error, En4dvarError) or (within and not where):  # where it takes other arguments, it is not begun
            raise
        raise _wrong(scheme, method, f"raises {describe(error)}{where}") from None


def _wrong(scheme: Scheme, method: str, words: str) -> ConfigError:
    return ConfigError(f"scheme {type(scheme).__name__}: {method} {words}")


def members_of(scheme: Scheme, weights: Weights, basis: Array | None = None) -> Array:
    rows, n = _asked(scheme, "members", weights, *([] if basis is None else [basis])), len(weights.w)
    if np.ndim(rows) != 2 or np.shape(rows)[1] != n or not math.isfinite(np.sum(rows)):
        raise _wrong(scheme, "members", f"gives shape {np.shape(rows)}; it gives finite numbers of shape (M, {n})")
    return np.asarray(rows)


def linearised(scheme: Scheme, weights: Weights, runs: Runs) -> tuple[Array, Array]:
    told, size = _asked(scheme, "linearise", weights, runs), runs.predictions.shape[1]
    n = len(weights.w) if scheme.minimiser is None or runs.basis is None else runs.basis.shape[1]
    shapes = [np.shape(part) for part in told] if isinstance(told, tuple | list) else type(told).__name__
    if shapes != [(size,), (n, size)] or not math.isfinite(np.sum(told[0]) + np.sum(told[1])):
        right = f"a pair of arrays of finite numbers, of shapes {(size,)} and {(n, size)}"
        raise _wrong(scheme, "linearise", f"gives {shapes}; it gives {right}")
    return np.asarray(told[0]), np.asarray(told[1])


def step_of(
    scheme: Scheme, weights: Weights, evaluation: Evaluation, iteration: int, draw: Draw
) -> Step | GaussNewtonStep:
    step, n = _asked(scheme, "advance", weights, evaluation, iteration, draw), len(weights.w)
    if isinstance(step, GaussNewtonStep):
        return step
    if not (isinstance(step, Step) and isinstance(step.weights, Weights)):
        raise _wrong(scheme, "advance", f"gives {short(repr(step))}; it gives a Step or a GaussNewtonStep")
    w, T = np.asarray(step.weights.w), step.weights.T
    square = T.shape in ((n, n), (0, 0)) if isinstance(T, np.ndarray) else hasattr(type(T), "dense")
    if not (square or isinstance(T, np.ndarray)):
        kind = type(T).__name__
        raise _wrong(scheme, "advance", f"gives a transform of type {kind}; it is a numpy array of shape {(n, n)}")
    if w.shape + np.shape(step.norm) != (n,) or not square:
        shapes = f"weights {w.shape}, transform {np.shape(T)} and norm {np.shape(step.norm)}"
        raise _wrong(scheme, "advance", f"gives {shapes}; they are {(n,)}, {(n, n)} and a number")
    if not math.isfinite(np.sum(w) + step.norm + (np.sum(T) if isinstance(T, np.ndarray) else 0)):
        raise _wrong(scheme, "advance", "gives weights, a transform or a norm that are not finite")
    return step


def is_done(scheme: Scheme, iteration: int, step: Step | GaussNewtonStep) -> bool:
    """:meth:`Scheme.done`, true in the end."""
    done = bool(_asked(scheme, "done", iteration, step))
    said = scheme.passes, getattr(scheme, "max_iterations", 0), *vars(scheme).values()  # any key may be their number
    if not done and iteration + 1 >= max(MOST, *(value for value in said if isinstance(value, int))):
        taken = counted(iteration + 1, "iteration")
        why = f"is not true after {taken}; a scheme that takes more has a key max_iterations"
        raise _wrong(scheme, "done", why)
    return done
