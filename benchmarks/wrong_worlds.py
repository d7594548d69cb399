"""What laboratories do not know of: worlds that recordings.py films and that a fit does not suppose."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import numpy as np

from en4dvar.model.forward import Failure, ForwardModel
from en4dvar.model.state import Array
from en4dvar.priors.prior import PriorTerm
from en4dvar.priors.varying import PiecewiseModel, RandomWalk
from en4dvar_bubble.laws.parameters import G
from en4dvar_bubble.laws.viscous import Carreau
from en4dvar_bubble.model import BubbleModel
from en4dvar_bubble.settings import BubbleSettings


@dataclass(frozen=True)
class Wrong:
    """What differs from what is ``fitted``: there is another ``law`` with parameters ``of_law`` made from its own,
    other ``constants``, a rigid wall ``wall`` R_max away; the camera is faster than the file says by ``rate``; a shape
    mode 2 of ``shape`` (m) rings from the first collapse on along the line of sight; G is ``softened`` there.
    """

    fitted: str = "neo-hookean-kelvin-voigt"
    law: str = ""
    of_law: Mapping[str, Any] = field(default_factory=dict)
    constants: Mapping[str, str] = field(default_factory=dict)
    wall: float = 0.0
    rate: float = 1.0
    shape: float = 0.0
    softened: float = 1.0

    def model(
        self, truth: Mapping[str, float], physics: Mapping[str, Any], constants: Mapping[str, str]
    ) -> BubbleModel:
        """The model that makes the readings."""
        wall = {"wall": {"distance": f"{1e6 * self.wall * truth['R_max']} um"}} if self.wall else {}
        law = {"law": self.law or self.fitted, "constants": {**constants, **self.constants}}
        return BubbleModel.from_settings(BubbleSettings.model_validate({**physics, "start": "laser", **law, **wall}))

    def values(self, truth: Mapping[str, float]) -> dict[str, float]:
        """Of the parameters of that model."""
        return {**truth, **{name: of(truth) for name, of in self.of_law.items()}}

    def radius(self, model: BubbleModel, truth: Mapping[str, float], times: Array) -> Array | None:
        """What the camera sees (m) at ``times``; None where the bubble cannot be followed."""
        theta = {name: np.array([value]) for name, value in self.values(truth).items()}
        radius = _path(model, theta, times)
        if radius is None or (self.shape, self.softened) == (0.0, 1.0):
            return radius
        first = int(np.argmin(radius[: int(0.3 * len(times))]))  # two and a half times the collapse without elasticity
        if self.softened != 1.0:
            term = PriorTerm.lognormal(G, truth["G"], 1.0)
            walk = RandomWalk.of(model, term, (float(times[first]),), 1.0)
            theta[walk.changes[0].parameter.name] = np.array([np.log(self.softened)])
            radius = _path(PiecewiseModel(model, [walk]), theta, times)
        if radius is not None and self.shape:
            of = np.sqrt(12 * model.medium.S / model.medium.rho / radius**3)  # Lamb's frequency of mode 2
            phase = np.concatenate([[0.0], np.cumsum(0.5 * (of[1:] + of[:-1]) * np.diff(times))])
            ringing = np.arange(len(times)) >= first
            radius = radius + ringing * self.shape * np.sin(phase - phase[first])
        return radius

    def as_fitted(self, truth: Mapping[str, float], times: Array, radius: Array) -> dict[str, float]:
        """True values of the fitted law's parameters: of a liquid that thins μ is the mean of its viscosity, by what
        it dissipates, R Ṙ² ∫ μ(2√3 |Ṙ/R| s) ds, for it has no other.
        """
        if self.law != Carreau.name:
            return dict(truth)
        speed, shares = np.gradient(radius, times), (np.arange(50) + 0.5) / 50
        rates = 12**0.5 * np.abs(speed / radius)[:, None] * shares
        viscosity = Carreau().viscosity(rates, SimpleNamespace(**self.values(truth))).mean(axis=1)
        return {**truth, "mu": float(np.average(viscosity, weights=radius * speed**2))}


def _path(model: ForwardModel, theta: Mapping[str, Array], times: Array) -> Array | None:
    (path,) = model.trajectories(model.initial_states(theta), times)
    return None if isinstance(path, Failure) else path["R"]


CARREAU = {
    "mu_0": lambda truth: truth["mu"],
    "mu_inf": lambda truth: 0.1 * truth["mu"],
    "shear_time": lambda truth: 0.01 * truth["R_max"],  # s: one tenth of the collapse time, near enough
    "n": lambda truth: 0.7,
}
WORLDS = {
    "pressure": Wrong(constants={"p_inf": "98.285 kPa"}),
    "gel": Wrong(constants={"rho": "1060 kg/m^3", "c": "1580 m/s"}),
    "frame-rate": Wrong(rate=1.02),
    "wall-3": Wrong(wall=3.0),
    "wall-10": Wrong(wall=10.0),
    "shape": Wrong(shape=4e-6),
    "softening": Wrong(softened=0.5),
    "carreau": Wrong(fitted="newtonian", law="carreau", of_law=CARREAU),
    "locking": Wrong(law="gent-kelvin-voigt", of_law={"J_m": lambda truth: 300.0}),  # stands for Arruda and Boyce's
}
