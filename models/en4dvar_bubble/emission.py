r"""The reading of a hydrophone far from the bubble: the pressure of the wave that the bubble itself sends out.

Near the bubble the liquid is incompressible, far from it the wave is φ = −F(t − r/c)/r (Keller & Miksis 1980, J.
Acoust. Soc. Am. 68, 628). Bernoulli's equation at the wall then gives

    r p(r, t + r/c) = ρ F′ = R (p_L − p_∞ − p_f + ρ Ṙ²/2),        p_L = p_b − 2S/R + J − 4μ Ṙ/R,

with the stress integral J of the medium: what the path knows, without a derivative of it. In an incompressible liquid
this is ρ (R² R̈ + 2 R Ṙ²), the second derivative of the volume times ρ/4π. Near a plane the pressure of the image,
±ρF′/(2h), belongs to the right-hand side; the wave that the plane reflects is left out. The pulse itself, which the
hydrophone meets too, is not in it, nor are steepening and absorption on the way.
"""

from typing import Any

import numpy as np

from en4dvar.model.forward import Observable
from en4dvar.model.state import Array
from en4dvar_bubble.paths import OF_WHOLE, OfPath, Paths


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
    medium, R, Rdot = run.medium(1), run["R"], run["Rdot"]
    excess = run["p_b"] - 2 * medium.S / R + run["S"] - medium.p_inf - _driving(run)
    nearby = 1 + R * np.reshape(model.image(model.parameter_values(run.initial)), (-1, 1))  # the image's pressure
    source = R * (excess + 0.5 * medium.rho * Rdot**2) / nearby
    return np.where((run.solution.status != 0)[:, None], np.nan, source / model.hydrophone)


OBSERVABLE = Observable(
    "acoustic_pressure",
    "Pa",
    OfPath("pressure sent out"),
    r"$p_\mathrm{ac}$",
    "kPa",
    "pressure that the bubble sends out",
)
OF_WHOLE["pressure sent out"] = emitted


def _driving(run: Paths) -> Array:
    """p_f in Pa at the bubble, (N, K), as the equation of motion reads it; 0 where there is none."""
    model: Any = run.model
    if model.driving.silent:
        return np.zeros(1)
    when = run.times + (0.0 if model.reading == "instantaneous" else run["R"] / run.medium(1).c)
    return np.asarray(model.driving.of_each(when, model.parameter_values(run.initial)))
