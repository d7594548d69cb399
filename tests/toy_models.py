"""A damped oscillator in SI units: the smallest model that can be named in YAML (``toy_models:Oscillator``)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from en4dvar.model.forward import ForwardModel, Observable, StateField
from en4dvar.model.state import Array, Parameter, StateLayout
from en4dvar.model.state import Field as StateBlock
from en4dvar.plumbing.units import Quantity


class OscillatorSettings(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)
    law: Literal["linear", "cubic"] = "linear"
    mass: Annotated[float, Quantity("kg"), Field(gt=0)] = 1.0
    table: Path | None = None


class Oscillator(ForwardModel):
    """m x'' + c x' + k x (+ k x³/L²) = 0 from rest at x = A; exact steps for the linear law."""

    parameters = (
        Parameter("A", "m", bounds=(0.0, np.inf), display_unit="um", label="initial amplitude"),
        Parameter("k", "N/m", "lognormal", bounds=(0.0, np.inf), label="stiffness"),
        Parameter("c", "N s/m", bounds=(0.0, np.inf), label="damping"),
    )
    layout = StateLayout(
        (StateBlock("x", unit="m"), StateBlock("v", unit="m/s"), StateBlock("k", unit="N/m"), StateBlock("c"))
    )
    observables = (Observable("position", "m", StateField("x", rate_of="v"), symbol="x", display_unit="um"),)
    defaults: Mapping[str, float] = {"c": 0.0}
    Settings = OscillatorSettings

    def __init__(self, settings: OscillatorSettings):
        self.mass = settings.mass

    @classmethod
    def from_settings(cls, settings: OscillatorSettings) -> Oscillator:
        return cls(settings)

    def initial_state(self, theta: Mapping[str, float]) -> Array:
        return self.layout.pack({"x": theta["A"], "v": 0.0, "k": theta["k"], "c": theta["c"]})

    def step(self, x: Array, t0: float, t1: float) -> Array:
        x0, v0, k, c = x.tolist()  # hundreds of these steps are most of what a test's run takes: no numbers of numpy
        a, dt = c / (2 * self.mass), t1 - t0
        square = k / self.mass - a**2
        w = math.sqrt(square) if square > 0 else math.nan  # when overdamped: the member fails
        cosine, sine, decay = math.cos(w * dt), math.sin(w * dt) / w, math.exp(-a * dt)
        position = decay * (x0 * cosine + (v0 + a * x0) * sine)
        velocity = decay * (v0 * cosine - (a * v0 + (a**2 + w**2) * x0) * sine)
        return np.array([position, velocity, k, c])


class Undamped(Oscillator):
    """Has no damping to be estimated."""

    parameters = Oscillator.parameters[:2]
    defaults: Mapping[str, float] = {}

    def initial_state(self, theta: Mapping[str, float]) -> Array:
        return super().initial_state({**theta, "c": 0.0})


class Fragile(Oscillator):
    """Cannot be integrated at all."""

    def step(self, x: Array, t0: float, t1: float) -> Array:
        raise ArithmeticError("no step succeeds")


class Brittle(Oscillator):
    """Cannot be integrated where it is stiffer than 3.5 N/m."""

    def initial_state(self, theta: Mapping[str, float]) -> Array:
        if theta["k"] > 3.5:
            raise ArithmeticError("too stiff")
        return super().initial_state(theta)
