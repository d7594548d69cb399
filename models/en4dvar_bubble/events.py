r"""Observables that need no camera: the turning points of a bubble, and the pressure that it sends out.

Largest radius, collapses, rebounds. An event is where the wall stands still, Ṙ = 0: functionals of the path, the same
whatever instant they are read at. The largest maximum comes first (a released bubble starts there), then collapses and
rebounds in turn. The time of an event is counted from the start of the model, which a released bubble's R_max is; the
time between two does not depend on it. Paths are followed to :data:`HORIZON` times the last reading, on a grid; where
the events end long before, again on a grid that ends with them. Each bracket of Ṙ = 0 is then divided twice by running
the members again at instants of their own, and Ṙ is taken for linear in the last. A bubble of 300 µs has its collapse
to better than 0.1 ns (tests/bubble/test_events.py). A member that has no such event (NaN) is excluded by the reading of
it; one whose run fails (infinity) is lost.

A hydrophone far away. Near the bubble the liquid is incompressible, far from it the wave is φ = −F(t − r/c)/r (Keller &
Miksis 1980, J. Acoust. Soc. Am. 68, 628). Bernoulli's equation at the wall then gives

    r p(r, t + r/c) = ρ F′ = R (p_L − p_∞ − p_f + ρ Ṙ²/2),        p_L = p_b − 2S/R + J − 4μ Ṙ/R,

with the stress integral J of the medium: what the path knows, without a derivative of it. In an incompressible liquid
this is ρ (R² R̈ + 2 R Ṙ²), the second derivative of the volume times ρ/4π. Near a plane the pressure of the image,
±ρF′/(2h), belongs to the right-hand side; the wave that the plane reflects is left out. The pulse itself, which the
hydrophone meets too, is not in it, nor are steepening and absorption on the way.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from en4dvar.model.forward import Observable
from en4dvar.model.state import Array
from en4dvar_bubble.paths import OF_WHOLE, OfPath, Paths

HORIZON = 2.0  # of the last reading
GRID, PARTS = 240, 24  # instants of the first run, and of each bracket in a later one
SHORTER, ROUNDS = 0.8, 6  # part of a grid that the events must reach to, else another one ends there; grids at most
COLLAPSES = 3


def events(paths: Paths) -> Mapping[str, Array]:
    """``time`` (s) and ``radius`` (m) of every member's events, (N, 2·:data:`COLLAPSES`), NaN where there is none,
    infinite where the run failed; the largest radius comes first, then first collapse, first rebound, ….

    Raises ValueError: the paths do not start where the model does.
    """
    if np.any(paths.start):
        raise ValueError("collapses and rebounds are read from whole paths, which a resumed one is not")
    model: Any = paths.model
    until = HORIZON * np.max(paths.times, axis=1, keepdims=True)
    for _ in range(ROUNDS):
        times = until * np.linspace(0, 1, GRID)
        low, high = _brackets(model.integrate(paths.initial, times), times)
        end = np.nan_to_num(high).max(axis=1, keepdims=True)
        ends = (end > 0) & (end < SHORTER * until)
        if not ends.any():
            break
        until = np.where(ends, end, until)
    for _ in range(2):
        times = low[..., None] + (high - low)[..., None] * np.linspace(0, 1, PARTS)
        flat = np.where(np.isfinite(times), times, until[..., None]).reshape(len(times), -1)
        run = model.integrate(paths.initial, flat)
        V, R = (run[name].reshape(times.shape) for name in ("Rdot", "R"))
        at = np.argmax(_turns(V), axis=-1)[..., None]
        low, high, V0, V1, R0 = (
            np.take_along_axis(a, at + i, axis=2)[..., 0] for a, i in ((times, 0), (times, 1), (V, 0), (V, 1), (R, 0))
        )
        failed, absent = (run.solution.status != 0)[:, None], ~np.isfinite(low)
    share = np.where(V0 == V1, 0.0, V0 / np.where(V0 == V1, 1.0, V0 - V1))
    return {
        "time": np.where(failed, np.inf, np.where(absent, np.nan, low + share * (high - low))),
        "radius": np.where(failed, np.inf, np.where(absent, np.nan, R0 + 0.5 * share * V0 * (high - low))),
    }


def _turns(V: Array) -> Any:
    """Whether V changes its sign in each interval along the last axis."""
    return np.signbit(V[..., 1:]) != np.signbit(V[..., :-1])


def _brackets(run: Paths, times: Array) -> tuple[Array, Array]:
    """Instants (N, 2·COLLAPSES) before and after each event, NaN where there is none."""
    n, count = len(times), 2 * COLLAPSES
    low, high = np.full((2, n, count), np.nan)
    turned, R = _turns(run["Rdot"]), run["R"]
    for i in np.flatnonzero(run.solution.status == 0):
        top = int(np.argmax(R[i]))
        turns = np.flatnonzero(turned[i])
        if top == 0:  # released from the largest radius
            low[i, 0], high[i, 0], first = times[i, 0], times[i, 0], turns[turns > 0]
        else:
            after = turns[turns >= top - 1]
            if not len(after):
                continue
            if run["Rdot"][i, after[0]] < 0:  # more than one turn between two instants: a finer grid tells
                high[i, 0] = times[i, after[:count][-1] + 1]
                continue
            low[i, 0], high[i, 0], first = times[i, after[0]], times[i, after[0] + 1], after[1:]
        kept = first[: count - 1]
        low[i, 1 : 1 + len(kept)], high[i, 1 : 1 + len(kept)] = times[i, kept], times[i, kept + 1]
    return low, high


def _observable(name: str, symbol: str, label: str, what: str, event: int, since: int | None = None) -> Observable:
    """``what`` of the path, for all its instants: ``time`` or ``radius`` of an event, or the time since another."""

    def read(paths: Paths) -> Array:
        located = paths["turning points"][what]
        value = located[:, event] - (0.0 if since is None else located[:, since])
        return np.tile(value[:, None], (1, paths.times.shape[1]))

    OF_WHOLE[label] = read
    unit, shown = ("s", "us") if what == "time" else ("m", "um")
    return Observable(name, unit, OfPath(label), symbol, shown, label, positive=True, fewest=1, event=True)


def _numbered(name: str, k: int) -> str:
    return name if k == 1 else f"{name}_{k}"


def emitted(paths: Paths) -> Array:
    """(N, K) Pa at the model's hydrophone, at the instants at which it arrives there; the paths are run again, at the
    instants (s) when it was sent. Raises ValueError: they do not start where the model does.
    """
    if np.any(paths.start):
        raise ValueError("what the bubble sent out before is read from whole paths, which a resumed one is not")
    model: Any = paths.model
    sent = paths.times - model.hydrophone / paths.medium(1).c
    if model.start == "acoustic":  # at rest before time zero
        sent = np.maximum(sent, 0.0)
    run = model.integrate(paths.initial, sent)
    medium, R, Rdot, own = run.medium(1), run["R"], run["Rdot"], model.parameter_values(run.initial)
    driven = model.driving.of_each(sent + (0.0 if model.reading == "instantaneous" else R / medium.c), own)
    excess = run["p_b"] - 2 * medium.S / R + run["S"] - medium.p_inf - driven
    nearby = 1 + R * np.reshape(model.image(own), (-1, 1))  # the image's pressure
    source = R * (excess + 0.5 * medium.rho * Rdot**2) / nearby
    return np.where((run.solution.status != 0)[:, None], np.nan, source / model.hydrophone)


SENT = "pressure that the bubble sends out"
HEARD = Observable("acoustic_pressure", "Pa", OfPath(SENT), r"$p_\mathrm{ac}$", "kPa", SENT)
OF_WHOLE.update({"turning points": events, SENT: emitted})
OBSERVABLES = (
    _observable("largest_radius", r"$R_\mathrm{max}$", "largest radius", "radius", 0),
    *(
        _observable(_numbered("collapse_time", k), f"$t_{{c{k}}}$", f"time of collapse {k}", "time", 2 * k - 1)
        for k in range(1, COLLAPSES + 1)
    ),
    *(
        _observable(_numbered("rebound_radius", k), f"$R_{{r{k}}}$", f"height of rebound {k}", "radius", 2 * k)
        for k in range(1, COLLAPSES)
    ),
    _observable("period", "$T$", "time from first to second collapse", "time", 3, since=1),
    HEARD,
)
