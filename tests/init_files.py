"""Calls of ``en4dvar init``, and the files that it is given."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from click.testing import CliRunner, Result
from scipy.integrate import solve_ivp

from en4dvar.assembly.build import build
from en4dvar.cli import main
from en4dvar.config import Config, load_config

UNITS = ("--time-unit", "us", "--radius-unit", "um")
TRUTH = {
    "acoustic": {"G": 420.0, "alpha": 0.029, "mu": 0.086, "R0": 0.43e-6, "t_s": 0.25e-6},
    "laser": {"G": 2500.0, "mu": 0.09, "R_eq": 22e-6, "R_max": 195e-6, "t_s": 0.0},
}


def call(*arguments: str | Path, **options: str) -> Result:
    return CliRunner().invoke(main, [str(a) for a in arguments], **options)  # type: ignore[arg-type]


def simulate(start: str, times: str, noise_std: str, path: Path, seed: int = 1) -> Path:
    """Synthetic data at TRUTH, by ``en4dvar simulate`` from a configuration without data."""
    units = {"G": "Pa", "alpha": "", "mu": "Pa s", "R0": "m", "R_eq": "m", "R_max": "m", "t_s": "s"}
    values = [f"  {name}: {value} {units[name]}".rstrip() for name, value in TRUTH[start].items()]
    law = {"acoustic": "quadratic-kelvin-voigt", "laser": "neo-hookean-kelvin-voigt"}[start]
    gas = {"acoustic": "heat", "laser": "polytropic, vapour_pressure: saturated"}[start]
    model = f"model: {{name: bubble, law: {law}, start: {start}, gas: {gas}}}"
    config = path.with_suffix(".truth.yaml")
    config.write_text("\n".join(["name: truth", model, "parameters:", *values, ""]), encoding="utf-8")
    done = call(
        "simulate", config, "--times", times, "--noise", noise_std, "--seed", str(seed), "--out", path, "--force"
    )
    assert done.exit_code == 0, done.output
    return path


def proposed(path: Path) -> Config:
    config = load_config(path)
    build(config)  # and its data can be read
    return config


def write(path: Path, header: str = "t_us,R_um", scale: float = 1.0) -> Path:
    """A film of a released bubble: Rayleigh's collapse, rebound, rest."""
    times = np.arange(60) * 0.7
    rebound = 60 * np.sqrt(np.clip(1 - ((times - 27) / 8) ** 2, 0, 1))
    radius = np.where(times < 18.2, 195 * np.clip(1 - (times / 18.5) ** 2, 0, 1) ** 0.4, np.maximum(rebound, 22))
    path.write_text("\n".join([header, *(f"{t:g},{scale * r:g}" for t, r in zip(times, radius, strict=True)), ""]))
    return path


def rebounding(step: float, offset: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """A bubble of polytropic gas that rebounds, integrated here, in R_max and in Rayleigh's R_max √(ρ/p∞), top at 0."""

    def rhs(_: float, y: np.ndarray) -> list[float]:
        return [y[1], (0.002 * y[0] ** -4.2 - 1 - 0.05 * y[1] / y[0] - 1.5 * y[1] ** 2) / y[0]]

    path = solve_ivp(rhs, (0, 3), [1.0, 0.0], dense_output=True, rtol=1e-9)
    t = np.arange(-0.5 + offset, 3, step)
    return t, path.sol(np.abs(t))[0]
