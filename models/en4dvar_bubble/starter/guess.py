"""First guesses of G and μ from two numbers of a history, by the forward model itself.

Acoustic start: R_max and the collapse time (the driving is known, so both follow from G and μ). Laser start: the
collapse time and the rebound's height over R_max (R_max is where the model starts). The model is run on a grid of G and
μ, every other parameter at the centre of its prior; each node is weighted by exp(−½ Σ (ln feature − ln observed)²/s²),
of a gel also by what gels are known to be, which decides where the numbers tell little; the guess is the weighted
geometric mean. Collapse times of model and data are taken in the same way
(:func:`~en4dvar_bubble.collapse.lobe`).

A guess has seen the data that a prior is then confronted with. A wide one is centred on it where these determine G and
μ by themselves, as of laser-induced bubbles: centred on what gels are known to be, it moves ln G of measured ones by a
twentieth of its std, of soft synthetic ones by a fifth. A pulse that stretches a gel hundreds of times tells G α/R0
alone, and a G that fits with α and R0 at their medians would count what is known of these twice.
"""

import itertools
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from en4dvar.model.forward import Trajectory
from en4dvar.model.state import Array
from en4dvar.plumbing.errors import DataError
from en4dvar_bubble.collapse import COMMON, lobe
from en4dvar_bubble.model import BubbleModel
from en4dvar_bubble.solver.driver import preset
from en4dvar_bubble.starter.look import second_maximum

GRID: Mapping[str, Array] = {"G": np.geomspace(50.0, 2e5, 25), "mu": np.geomspace(3e-3, 1.0, 18)}  # Pa, Pa s
OF_GELS: Mapping[str, tuple[float, float]] = {"G": (5e3, 1.5), "mu": (0.08, 1.2)}
"""Medians (SI) and log_std of what is known of a gel without its history, wide enough for those that bubbles were used
on: 0.03 (Mancia 2021) to 0.19 Pa s (Yang 2020), a tenth of a kPa to some tens."""
STIFFENING = (0.05, 3.0)  # median and log_std of α: one of 0.001 is none, for 4 α λ < 5/2 at a pulse's λ of hundreds
RELAXING = {"mu_p": OF_GELS["mu"], "relaxation_time": (1e-6, 1.5)}  # median (SI) and log_std: 0.08 to 12 µs
SPAN = {
    "alpha": "none (neo-Hookean: fix it at 0), agarose 0.03 (Mancia 2021), polyacrylamide 0.48 (Yang 2020)",
    "mu_p": "as mu of gels",
    "relaxation_time": "within what a collapse can show",
}
TOLERANCE = {"R_max": 0.05, "t_c": 0.05, "rebound": 0.15}  # s, of the logarithm
FAR = 3.0  # in units of s: no node reproduces the observed numbers
POINTS = 400


@dataclass(frozen=True)
class Guess:
    """``values`` SI by name; ``log_std`` how far the nodes that fit are spread (std of ln); ``misfit`` of the best
    node in units of s; ``source``, where the values are from; ``unmatched``, the observed numbers that no node comes
    close to, each by itself, all of them where each can be had without the others. Empty where the law has neither
    ``G`` nor ``mu`` or no node could be run.
    """

    values: Mapping[str, float] = field(default_factory=dict)
    log_std: Mapping[str, float] = field(default_factory=dict)
    misfit: float = 0.0
    source: str = ""
    unmatched: tuple[str, ...] = ()

    def common(self) -> "Guess":
        """No stiffer or thicker than half of what common gels are at most: for a history that is doubted."""
        most = COMMON._asdict()
        values = {name: min(value, 0.5 * most.get(name, np.inf)) for name, value in self.values.items()}
        return replace(self, values=values, source="within what gels usually are, for the collapse is doubted")


def first_guess(model: BubbleModel, fixed: Mapping[str, float], observed: Mapping[str, float]) -> Guess:
    """Guesses of those of G and μ that the law has. ``fixed``: SI values of every other parameter of the model.
    ``observed``: ``t_c`` (s) and, where known, ``R_max`` (m; acoustic) or ``rebound`` (laser); NaN is unknown.
    """
    names = [name for name in GRID if any(p.name == name for p in model.parameters)]
    if not names:
        return Guess()
    if model.start == "laser":  # whose equations are many; an order of magnitude needs no more
        model = replace(model, accuracy=preset("fast", "laser"))
    nodes = np.array(list(itertools.product(*(GRID[name] for name in names))))
    theta = {name: np.full(len(nodes), value) for name, value in fixed.items()}
    theta |= {name: nodes[:, i] for i, name in enumerate(names)}
    reach = (4.0 if model.start == "laser" else 5.0) * observed["t_c"]
    times = np.linspace(0.0, reach + max(0.0, getattr(model.driving, "end", 0.0)), POINTS)
    paths = model.trajectories(model.initial_states(theta), times)
    keys = [
        k for k in ("R_max" if model.start == "acoustic" else "rebound", "t_c") if np.isfinite(observed.get(k, np.nan))
    ]
    misfit, off = np.full(len(nodes), np.inf), np.full(len(keys), np.inf)
    for i, path in enumerate(paths):
        if isinstance(path, Trajectory):
            seen = _features(times, path["R"])
            terms = [np.log(seen[k] / observed[k]) / TOLERANCE[k] for k in keys]
            misfit[i] = float(np.sum(np.square(terms))) if np.all(np.isfinite(terms)) else np.inf
            off = np.fmin(off, np.abs(terms))
    unmatched = tuple(k for k, least in zip(keys, off, strict=True) if least > FAR) or tuple(keys)
    if not np.any(np.isfinite(misfit)):
        return Guess(misfit=float("inf"), unmatched=unmatched)
    logs, known = np.log(nodes), np.zeros(len(nodes))
    if "G" in names:
        known = sum(((logs[:, i] - np.log(OF_GELS[n][0])) / OF_GELS[n][1]) ** 2 for i, n in enumerate(names))
    weights = np.exp(-0.5 * (misfit - misfit.min() + known))
    weights /= weights.sum()
    mean = weights @ logs
    spread = np.sqrt(weights @ (logs - mean) ** 2)
    told = "R_max and collapse time" if "R_max" in keys else "collapse time" + " and rebound" * ("rebound" in keys)
    return Guess(
        {name: float(np.exp(m)) for name, m in zip(names, mean, strict=True)},
        {name: float(s) for name, s in zip(names, spread, strict=True)},
        float(np.sqrt(misfit.min())),
        f"first guess from {told}",
        unmatched,
    )


def _features(times: Array, radius: Array) -> dict[str, float]:
    try:
        peak = lobe(times, radius)
    except DataError:
        return {"R_max": np.nan, "t_c": np.nan, "rebound": np.nan}
    return {"R_max": peak.R_max, "t_c": peak.t_c, "rebound": second_maximum(radius)}
