"""A forward run at given parameters, seen through the observation operator: predictions, or synthetic observations.

A synthetic campaign is many of them: truths drawn from distributions, observed as an experiment would observe them.
Each data set has its own stream of random numbers, by (seed, its name): adding data sets leaves the others as they
were. When a series ends is decided by its readings alone, never by the truth. No reading is refused for its value, not
even one that noise puts below zero: that would bias the noise, and with it whatever such readings tell.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

import numpy as np
import numpy.typing as npt

from en4dvar.assembly.build import needed_file, resolve_parameters
from en4dvar.assembly.reading import read_observations
from en4dvar.config import Config, time_grid
from en4dvar.config.data import DataPlan, SeriesPlan
from en4dvar.config.kinds import CampaignFile, GroupSection, terms_and_fixed
from en4dvar.config.load import Read
from en4dvar.config.parameters import Tied
from en4dvar.config.quantities import parse_error_std
from en4dvar.data.series import Places
from en4dvar.diagnosis.diagnostics import nrmse
from en4dvar.executor import run_chunk
from en4dvar.inputs.formats import TRUTHS
from en4dvar.inputs.parts import Column
from en4dvar.model.forward import Failure, ForwardModel, Observable, Trajectory, instants_of, read_along
from en4dvar.model.state import READING_OFFSET, READING_SCALE, TIME_SCALE, TIME_SHIFT, Array, floats
from en4dvar.plumbing.called import advised
from en4dvar.plumbing.errors import ConfigError, En4dvarError, OutputError
from en4dvar.plumbing.files import make_folder, write_text
from en4dvar.plumbing.hints import beside, counted, listed
from en4dvar.plumbing.tables import csv_text
from en4dvar.plumbing.units import UnitError, convert, unit_after
from en4dvar.plumbing.user_code import reason_of
from en4dvar.priors.prior import member_stream
from en4dvar.results.provenance import portable

ATTEMPTS = 100  # truths that cannot be integrated, or yield too few readings, are drawn again so often
TRUTH = "truth.csv"
THOUSANDTH = 3  # decimals, of the noise and of the time between readings, that numbers in files have at least


@dataclass(frozen=True)
class Simulation:
    """``series``: values (K,) of each by name, at ``times`` (K,), model units; ``theta`` what it was run with (SI)."""

    times: Array
    series: Mapping[str, Array]
    theta: Mapping[str, float]

    def __repr__(self) -> str:
        series = ", ".join(f"{name} {np.nanmin(v):.4g} to {np.nanmax(v):.4g}" for name, v in self.series.items())
        return f"<Simulation at {counted(len(self.times), 'time')}: {series}, units of the model>"

    @property
    def values(self) -> Array:
        """(K,) of the first series."""
        return next(iter(self.series.values()))

    def with_noise(self, std: float | Mapping[str, float], seed: int) -> "Simulation":
        """Independent Gaussian noise added, of a standard deviation in the observable's unit: one for all series, or
        by their names. Raises :class:`ConfigError`.
        """
        if seed < 0:
            raise ConfigError(f"seed: must not be negative, not {seed}")
        stream = np.random.Generator(np.random.Philox(seed))
        stds = std if isinstance(std, Mapping) else dict.fromkeys(self.series, std)
        if stds.keys() != self.series.keys() or not all(value >= 0 for value in stds.values()):
            raise ConfigError(f"std: give one for all series, or of each: {listed(self.series)}; none is negative")
        noisy = {name: v + stds[name] * stream.standard_normal(len(v)) for name, v in self.series.items()}
        return replace(self, series=noisy)


def simulate(config: Config, times: npt.ArrayLike | None = None) -> Simulation:
    """Run the model once, at the fixed values and the centres of the priors (median, in the prior's own transform).

    ``times``: (K,) instants from 0 on, of every series, increasing, in the model's unit; default ``simulate.times`` of
    the configuration, else those of the first data set.

    Raises :class:`ConfigError`, :class:`DataError`: no times, or a value that only the data know.
    :class:`En4dvarError`: the model fails.
    """
    for series in _series(config):
        _places(series, 1)
    times = config.simulate_times if times is None else times
    observations = None
    for name, file in needed_file(config, times).items():
        if times is None and not file.path.exists():
            words = "give the instants instead: simulate.times in the file, or --times FROM:TO:STEP"
            raise ConfigError(f"{file.path}: {beside(file.path)}; {words}")
        observations = read_observations(cast(DataPlan, config.data), file, name)
    if times is None:
        if observations is None:
            raise ConfigError("no instants to simulate: give simulate.times in the file, or --times FROM:TO:STEP")
        times = observations.instants[0]
    times = instants_of(times, unit := config.model.time_unit)
    if times[0] < 0:
        raise ConfigError(f"times: {times[0]:g} {unit} is before the model's clock begins, which is at 0")
    terms, fixed = resolve_parameters(config, observations)
    theta = {**fixed, **{t.parameter.name: float(t.to_physical(np.array(t.mean))) for t in terms}}
    theta |= {
        e.parameter.name: e.factor * theta[e.to]
        for e in config.parameters
        if isinstance(e, Tied) and e.parameter.name not in theta
    }
    return Simulation(times, _forward(config, theta, times), theta)


def _series(config: Config) -> tuple[SeriesPlan, ...]:
    return () if config.data is None else config.data.series


def _places(plan: SeriesPlan, count: int) -> Places | None:
    """Where on a field it is read, the same at ``count`` instants. Raises :class:`ConfigError` of several places."""
    places = plan.data.places
    if places is None:
        return None
    if places.positions is None or len(places.positions) != 1:
        raise ConfigError(f"{plan.name} is read at many places; a table has one value of it at a time: give one place")
    return places.places(count, None)


def parse_times(text: str, unit: str) -> Array:
    """``"0 us:60 us:1 us"`` as instants (K,) in ``unit``. Raises :class:`UnitError`."""
    parts = [part.strip() for part in text.split(":")]
    if len(parts) != 3:
        raise UnitError(f"{text!r} is not FROM:TO:STEP, e.g. '0 us:60 us:1 us'")
    start, end, step = parts
    return time_grid(start, end, step, unit)


def noise_level(text: str, config: Config, simulation: Simulation) -> dict[str, float]:
    """``"1.4 um"`` or ``"1 % of maximum"`` in the unit of each series. Raises :class:`UnitError`."""
    levels, observables = {}, _observables(config)
    for name, observable in observables.items():
        try:
            spread = parse_error_std(text, observable.unit)
        except (ConfigError, UnitError) as error:
            each = "; of several series, '1 % of maximum' is of each" if len(observables) > 1 else ""
            raise UnitError(f"--noise of {name}: {error}{each}") from None
        levels[name] = spread.absolute(float(simulation.series[name].max()))
    return levels


def _observables(config: Config) -> dict[str, Observable]:
    own = {series.name: series.observable for series in _series(config)}
    return own or {config.observable.name: config.observable}


def _forward(config: Config, theta: Mapping[str, float], times: Array) -> dict[str, Array]:
    model = config.model
    shift, names = theta.get(TIME_SHIFT.name, 0.0), {p.name for p in model.parameters}
    read = {name: value for name, value in theta.items() if name not in names}
    times = read.get(TIME_SCALE.name, 1.0) * times + shift
    path = _path(model, {name: value for name, value in theta.items() if name in names}, times)
    where = {series.name: _places(series, len(times)) for series in _series(config)}
    predictions = {}
    for name, observable in _observables(config).items():
        places = where.get(name)
        try:
            values = read_along(observable.operator, name, places is not None, path)
        except BaseException as error:
            raise En4dvarError(f"{observable.name} cannot be read from the run: {reason_of(error)}") from None
        values = values if places is None else places.read(values)
        predictions[name] = read.get(READING_SCALE.name, 1.0) * values + read.get(READING_OFFSET.name, 0.0)
    return predictions


def _path(model: ForwardModel, theta: Mapping[str, float], times: Array) -> Trajectory:
    """At times on the model's clock. Raises :class:`En4dvarError` where the model fails."""
    try:
        state = floats(model.initial_state(theta), "initial_state")
    except BaseException as error:
        reason = error if isinstance(error, ValueError) else reason_of(error)
        raise En4dvarError(f"the model refuses its parameters: {reason}") from None
    (path,) = run_chunk(model, state[None], times)
    if isinstance(path, Failure):
        raise En4dvarError(f"the model failed: {path.reason}")
    return path


def to_csv(simulation: Simulation, config: Config, comment: str = "") -> str:
    """The simulation as a CSV file with the columns and units of ``data.columns`` (else in display units)."""
    model, observable = config.model, config.observable
    time = Column(f"t_{model.time_display_unit}", model.time_display_unit, model.time_unit)
    value = Column(f"{observable.name}_{observable.display_unit}", observable.display_unit, observable.unit)
    columns = [value]
    if series := _series(config):
        stated = series[0].data.columns.time
        time = stated if isinstance(stated, Column) else time
        columns = [plan.data.columns.observable for plan in series]
        if len({column.name for column in columns}) < len(columns):  # series of several files
            columns = [replace(column, name=plan.name) for column, plan in zip(columns, series, strict=True)]
    units = {entry.parameter.name: entry.parameter.unit for entry in config.parameters}
    truth = ", ".join(f"{name} = {v:.9g}{unit_after(units[name])}" for name, v in simulation.theta.items())
    columns = [time, *columns]
    comments = [*comment.splitlines(), f"parameters: {truth}", ", ".join(f"{c.name} in {c.unit}" for c in columns)]
    values = [simulation.times, *simulation.series.values()]
    return _commented(comments, columns, values, [".9g"] * len(columns))


def _commented(
    comments: Sequence[str], columns: Sequence[Column], values: Sequence[Array], forms: Sequence[str]
) -> str:
    """Values (K,) of each column in its unit, each written in its form, as CSV below comments and names."""
    written = (convert(v, column.target, column.unit) for column, v in zip(columns, values, strict=True))
    rows = (",".join(map(format, row, forms)) for row in zip(*written, strict=True))
    return "\n".join([*(f"# {line}" for line in comments), ",".join(c.name for c in columns), *rows]) + "\n"


# A synthetic campaign


@dataclass(frozen=True)
class SyntheticSet:
    """Readings ``values`` (K,) told at ``times`` (K,), what they would be without noise, and the truth; SI."""

    name: str
    group: str
    times: Array
    values: Array
    exact: Array
    truth: Mapping[str, float]

    @property
    def nrmse(self) -> float:
        """NRMSE of the truth."""
        return nrmse(self.values, self.exact)


def draw_campaign(plan: Read[CampaignFile]) -> tuple[SyntheticSet, ...]:
    """Every data set of the campaign, named ``<group>_01`` …. Raises :class:`En4dvarError` where none can be drawn."""
    return tuple(
        _draw(plan, name, group, i + 1)
        for name, group in plan.file.campaign.groups.items()
        for i in range(group.datasets)
    )


def _draw(plan: Read[CampaignFile], kind: str, group: GroupSection, number: int) -> SyntheticSet:
    name = f"{kind}_{number:02d}"
    stream = member_stream(plan.file.seed, name)
    model, asked = plan.model, plan.file.campaign
    reason = ""
    for _ in range(ATTEMPTS):
        terms, theta = terms_and_fixed(group.parameters)
        theta |= {
            t.parameter.name: float(t.to_physical(np.array(t.mean + t.std * stream.standard_normal()))) for t in terms
        }
        shift = float(stream.uniform(*asked.time_shift))
        gaps = stream.uniform(*asked.spacing, asked.most - 1)
        times = stream.uniform(*asked.first) + np.concatenate([[0.0], np.cumsum(gaps)])
        noise = asked.noise * stream.standard_normal(asked.most)
        try:
            path = _path(model, theta, times + shift)
        except En4dvarError as error:
            reason = str(error)
            continue
        exact = read_along(model.observables[0].operator, model.observables[0].name, False, path)
        values = exact + noise
        below = np.flatnonzero(values < asked.stop * np.maximum.accumulate(values))
        count = int(below[0]) + 1 if len(below) else asked.most
        if count >= asked.fewest:
            truth = {**theta, TIME_SHIFT.name: shift}
            return SyntheticSet(name, kind, times[:count], values[:count], exact[:count], truth)
        reason = f"{count} usable readings"
    raise En4dvarError(f"{name}: no truth could be observed in {ATTEMPTS} attempts ({reason})")


def write_campaign(
    plan: Read[CampaignFile], sets: tuple[SyntheticSet, ...], folder: Path, command: str, force: bool = False
) -> Path:
    """One CSV file a data set and ``truth.csv``, which no estimation reads. Raises :class:`OutputError`."""
    files = [folder / f"{s.name}.csv" for s in sets] + [folder / TRUTH]
    if not force and (there := [file for file in files if file.exists()]):
        raise OutputError(f"{there[0]}: exists; give {advised('--force')} to replace it")
    make_folder(folder)
    for file, dataset in zip(files, sets, strict=False):
        write_text(file, _data_csv(plan, dataset, command))
    return write_text(folder / TRUTH, truth_csv(plan, sets))


def _data_csv(plan: Read[CampaignFile], dataset: SyntheticSet, command: str) -> str:
    model, seen = plan.model, plan.model.observables[0]
    t = Column(f"t_{model.time_display_unit}", model.time_display_unit, model.time_unit)
    v = Column(f"{seen.symbol.strip('$')}_{seen.display_unit}", seen.display_unit, seen.unit)
    noise, spacing = (
        convert(size, c.target, c.unit)
        for size, c in ((plan.file.campaign.noise, v), (plan.file.campaign.spacing[0], t))
    )
    comments = [
        f"SYNTHETIC data, no measurement: set {dataset.name} of the twin campaign {plan.file.name!r}",
        f"{portable(command)}; seed {plan.file.seed}",
        f"{t.name} in {t.unit}, {v.name} in {v.unit}; noise std {noise:.9g} {v.unit}",
    ]
    forms = [f".{max(5, THOUSANDTH - math.floor(math.log10(size)))}f" for size in (spacing, noise)]
    return _commented(comments, [t, v], [dataset.times, dataset.values], forms)


def truth_csv(plan: Read[CampaignFile], sets: tuple[SyntheticSet, ...]) -> str:
    """One line a data set: parameters in display units, NRMSE of the truth."""
    display = {p.name: (p.unit, p.display_unit or p.unit) for p in plan.model.parameters}
    display[TIME_SHIFT.name] = (plan.model.time_unit, plan.model.time_display_unit)
    heads = [name if unit == "1" else f"{name}_{unit.replace(' ', '_')}" for name, (_, unit) in display.items()]
    rows = [[*TRUTHS[:2], *heads, TRUTHS[2]]]
    for s in sets:
        row = [f"{convert(s.truth[name], *units):.9g}" for name, units in display.items()]
        rows.append([s.name, s.group, *row, f"{s.nrmse:.4f}"])
    about = f"# SYNTHETIC campaign {plan.file.name!r}: the truth behind its data sets; no estimation reads this file\n"
    return about + csv_text(rows)
