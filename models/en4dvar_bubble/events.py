r"""The turning points of a bubble: largest radius, collapses, rebounds; observables that need no camera.

An event is where the wall stands still, Ṙ = 0: functionals of the path, the same whatever instant they are read at. The
largest maximum comes first (a released bubble starts there), then collapses and rebounds in turn. The time of an event
is counted from the start of the model, which a released bubble's R_max is; the time between two does not depend on it.

Paths are followed to :data:`HORIZON` times the last reading, on a grid; each bracket of Ṙ = 0 is then divided twice by
running the members again at instants of their own, and Ṙ is taken for linear in the last. A bubble of 300 µs
has its collapse to better than 0.1 ns (tests/bubble/test_events.py). A member that has no such event fails.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from en4dvar.model.forward import Observable
from en4dvar.model.state import Array
from en4dvar_bubble.paths import BubbleTrajectory, Paths

HORIZON = 2.0  # of the last reading
GRID, PARTS = 240, 24  # instants of the first run, and of each bracket in a later one
COLLAPSES = 3


@dataclass(frozen=True)
class Turning:
    """H: ``what`` of the path, for all its instants: ``time`` or ``radius`` of event number ``event``, the largest
    radius being 0, the first collapse 1, the first rebound 2, …; with ``since`` the time since that event.
    """

    what: str
    event: int
    since: int | None = None
    batched: ClassVar[bool] = True

    def __call__(self, trajectory: Any) -> Array:
        """(K,) of a path, (N, K) of many. Raises ValueError: the path does not start where the model does."""
        if isinstance(trajectory, BubbleTrajectory):
            return np.full(len(trajectory.times), self._of(trajectory.paths)[trajectory.member])
        return np.tile(self._of(trajectory)[:, None], (1, trajectory.times.shape[1]))

    def _of(self, paths: Paths) -> Array:
        located = events(paths)
        if self.since is not None:
            return np.asarray(located["time"][:, self.event] - located["time"][:, self.since])
        return located[self.what][:, self.event]


def _observable(name: str, symbol: str, label: str, turning: Turning) -> Observable:
    unit, shown = ("s", "us") if turning.what == "time" else ("m", "um")
    return Observable(name, unit, turning, symbol, shown, label, positive=True, fewest=1)


def _numbered(name: str, k: int) -> str:
    return name if k == 1 else f"{name}_{k}"


OBSERVABLES = (
    _observable("largest_radius", r"$R_\mathrm{max}$", "largest radius", Turning("radius", 0)),
    *(
        _observable(_numbered("collapse_time", k), f"$t_{{c{k}}}$", f"time of collapse {k}", Turning("time", 2 * k - 1))
        for k in range(1, COLLAPSES + 1)
    ),
    *(
        _observable(_numbered("rebound_radius", k), f"$R_{{r{k}}}$", f"height of rebound {k}", Turning("radius", 2 * k))
        for k in range(1, COLLAPSES)
    ),
    _observable("period", "$T$", "time from first to second collapse", Turning("time", 3, since=1)),
)


def events(paths: Paths) -> Mapping[str, Array]:
    """``time`` (s) and ``radius`` (m) of every member's events, (N, 2·:data:`COLLAPSES`), NaN where there is none."""
    if np.any(paths.start):
        raise ValueError("collapses and rebounds are read from whole paths, which a resumed one is not")
    model: Any = paths.model
    if "events" not in paths.derived:
        until = HORIZON * np.max(paths.times, axis=1, keepdims=True)
        times = until * np.linspace(0, 1, GRID)
        low, high = _brackets(model.integrate(paths.initial, times), times)
        for _ in range(2):
            times = low[..., None] + (high - low)[..., None] * np.linspace(0, 1, PARTS)
            flat = np.where(np.isfinite(times), times, until[..., None]).reshape(len(times), -1)
            run = model.integrate(paths.initial, flat)
            V, R = (run[name].reshape(times.shape) for name in ("Rdot", "R"))
            at = _first_turn(V)
            low, high, V0, V1, R0 = (
                np.take_along_axis(a, at + i, axis=2)[..., 0]
                for a, i in ((times, 0), (times, 1), (V, 0), (V, 1), (R, 0))
            )
            lost = ~np.isfinite(low) | (run.solution.status != 0)[:, None]
        share = np.where(V0 == V1, 0.0, V0 / np.where(V0 == V1, 1.0, V0 - V1))
        paths.derived["events"] = {
            "time": np.where(lost, np.nan, low + share * (high - low)),
            "radius": np.where(lost, np.nan, R0 + 0.5 * share * V0 * (high - low)),
        }
    events: Mapping[str, Array] = paths.derived["events"]
    return events


def _first_turn(V: Array) -> Any:
    """Index (…, 1) of the first interval along the last axis in which V changes its sign, 0 where none does."""
    turns = np.signbit(V[..., 1:]) != np.signbit(V[..., :-1])
    return np.argmax(turns, axis=-1)[..., None]


def _brackets(run: Paths, times: Array) -> tuple[Array, Array]:
    """Instants (N, 2·COLLAPSES) before and after each event, NaN where there is none."""
    n, count = len(times), 2 * COLLAPSES
    low, high = np.full((2, n, count), np.nan)
    V, R = run["Rdot"], run["R"]
    for i in np.flatnonzero(run.solution.status == 0):
        top = int(np.argmax(R[i]))
        turns = np.flatnonzero(np.signbit(V[i, 1:]) != np.signbit(V[i, :-1]))
        if top == 0:  # released from the largest radius
            low[i, 0], high[i, 0], first = times[i, 0], times[i, 0], turns[turns > 0]
        else:
            after = turns[turns >= top - 1]
            if not len(after) or V[i, after[0]] < 0:
                continue
            low[i, 0], high[i, 0], first = times[i, after[0]], times[i, after[0] + 1], after[1:]
        kept = first[: count - 1]
        low[i, 1 : 1 + len(kept)], high[i, 1 : 1 + len(kept)] = times[i, kept], times[i, kept + 1]
    return low, high
