"""A forward run at given parameters, seen through the observation operator: predictions, or synthetic observations."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from en4dvar.config import Config, time_grid
from en4dvar.config.build import data_files, resolve_parameters
from en4dvar.config.data import Data
from en4dvar.config.error_std import parse_error_std
from en4dvar.config.parameters import Tied
from en4dvar.config.reading import read_observations
from en4dvar.config.series import DataPlan
from en4dvar.errors import ConfigError, En4dvarError
from en4dvar.executor import run_chunk
from en4dvar.forward import Failure
from en4dvar.inputs.readers import Column
from en4dvar.state import READING_SCALE, TIME_SHIFT, Array
from en4dvar.units import UnitError, convert
from en4dvar.user_code import reason_of


@dataclass(frozen=True)
class Simulation:
    """``values`` (K,) of the observable at ``times`` (K,), model units; ``theta`` what it was run with (SI)."""

    times: Array
    values: Array
    theta: Mapping[str, float]

    def with_noise(self, std: float, seed: int) -> Simulation:
        """Independent Gaussian noise of standard deviation ``std`` (observable's unit) added to the values."""
        stream = np.random.Generator(np.random.Philox(seed))
        return replace(self, values=self.values + std * stream.standard_normal(len(self.values)))


def simulate(config: Config, times: Array | None = None) -> Simulation:
    """Run the model once, at the fixed values and the centres of the priors (median, in the prior's own transform).

    Parameters
    ----------
    times: (K,) instants; default ``simulate.times`` of the configuration, else those of the first data set.

    Raises
    ------
    ConfigError, DataError: no times, or a value that only the data know. En4dvarError: the model fails.
    """
    if isinstance(config.data, DataPlan):
        raise ConfigError("a simulation is of one observable; the data of this file are several series")
    times = config.simulate_times if times is None else times
    observations = None
    if config.data is not None and (times is None or any(entry.needs_data for entry in config.parameters)):
        plan = DataPlan.of(config.data, config.observable)
        name, file = next(iter(data_files(plan).items()))
        observations = read_observations(plan, file, name)
    if times is None:
        if observations is None:
            raise ConfigError("no instants to simulate: give simulate.times in the file, or --times FROM:TO:STEP")
        times = observations.times
    terms, fixed = resolve_parameters(config, observations)
    theta = {**fixed, **{t.parameter.name: float(t.to_physical(np.array(t.mean))) for t in terms}}
    theta |= {
        e.parameter.name: e.factor * theta[e.to]
        for e in config.parameters
        if isinstance(e, Tied) and e.parameter.name not in theta
    }
    return Simulation(times, _forward(config, theta, times), theta)


def parse_times(text: str, unit: str) -> Array:
    """``"0 us:60 us:1 us"`` as instants (K,) in ``unit``. Raises :class:`UnitError`."""
    parts = [part.strip() for part in text.split(":")]
    if len(parts) != 3:
        raise UnitError(f"{text!r} is not FROM:TO:STEP, e.g. '0 us:60 us:1 us'")
    start, end, step = parts
    return time_grid(start, end, step, unit)


def noise_level(text: str, config: Config, simulation: Simulation) -> float:
    """``"1.4 um"`` or ``"1 % of maximum"`` in the observable's unit. Raises :class:`UnitError`."""
    spread = parse_error_std(text, config.observable.unit)
    if not spread.value > 0:
        raise UnitError(f"the noise must be positive, not {text}")
    return spread.absolute(float(simulation.values.max()))


def _forward(config: Config, theta: Mapping[str, float], times: Array) -> Array:
    model = config.model
    shift, names = theta.get(TIME_SHIFT.name, 0.0), {p.name for p in model.parameters}
    scale = 1.0 if READING_SCALE.name in names else theta.get(READING_SCALE.name, 1.0)
    try:
        own = {name: value for name, value in theta.items() if name in names}
        state = np.asarray(model.initial_state(own), dtype=float)
    except BaseException as error:
        reason = error if isinstance(error, ValueError) else reason_of(error)
        raise En4dvarError(f"the model refuses its parameters: {reason}") from None
    (path,) = run_chunk(model, state[None], times + shift)
    if isinstance(path, Failure):
        raise En4dvarError(f"the model failed: {path.reason}")
    try:
        return np.asarray(config.observable.operator(path), dtype=float) * scale
    except BaseException as error:
        raise En4dvarError(f"{config.observable.name} cannot be read from the run: {reason_of(error)}") from None


def to_csv(simulation: Simulation, config: Config, comment: str = "") -> str:
    """The simulation as a CSV file with the columns and units of ``data.columns`` (else in display units)."""
    model, observable, data = config.model, config.observable, config.data
    time = Column(f"t_{model.time_display_unit}", model.time_display_unit, model.time_unit)
    value = Column(f"{observable.name}_{observable.display_unit}", observable.display_unit, observable.unit)
    if isinstance(data, Data):
        time = data.columns.time if isinstance(data.columns.time, Column) else time
        value = data.columns.observable
    units = {entry.parameter.name: entry.parameter.unit for entry in config.parameters}
    truth = ", ".join(f"{name} = {v:.9g} {units[name]}" for name, v in simulation.theta.items())
    times = convert(simulation.times, time.target, time.unit)
    values = convert(simulation.values, value.target, value.unit)
    lines = [
        *(f"# {line}" for line in comment.splitlines()),
        f"# parameters: {truth}",
        f"# {time.name} in {time.unit}, {value.name} in {value.unit}",
        f"{time.name},{value.name}",
        *(f"{t:.9g},{v:.9g}" for t, v in zip(times, values, strict=True)),
    ]
    return "\n".join(lines) + "\n"
