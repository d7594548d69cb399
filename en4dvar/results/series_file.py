"""The result of a series: ``sequence.nc`` of data, ``twin.nc`` of a twin experiment, and their ``summary.csv``."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from en4dvar.model.forward import ForwardModel, Observable, StateField
from en4dvar.model.state import Array, Field, Shown
from en4dvar.plumbing.tables import csv_text
from en4dvar.plumbing.units import convert
from en4dvar.results.declared import Attribute, Declared, Item, Table, UnitRule, When, attributes_of, lay_out, text
from en4dvar.results.netcdf import Group, netcdf_attributes
from en4dvar.series.moments import SequentialState
from en4dvar.series.problem import SeriesProblem, SeriesResult
from en4dvar.series.twin import TwinResult

FILES = ("sequence.nc", "twin.nc")
CERTAIN = 1e-9  # of its size: the spread of what is known
MEAN = "mean_after_burn_in"  # attribute of the scores
STATE, OBSERVATION = "time state", "time observation"


def series_file(run_dir: Path) -> Path | None:
    """The result of a twin experiment or a sequence in a run directory; None where there is none."""
    return next((run_dir / name for name in FILES if (run_dir / name).is_file()), None)


def series_group(result: SeriesResult, attributes: Mapping[str, Any]) -> Group:
    """Estimates, observations and innovations in time; members of a sequence, truth and scores of a twin experiment."""
    file = "twin.nc" if isinstance(result, TwinResult) else "sequence.nc"
    root = netcdf_attributes({**attributes_of(ATTRIBUTES[file], result), **attributes})
    return Group(lay_out(TABLES[file], result, SCOPES), lay_out(COORDINATES[file], result, SCOPES), root)


# What is common to both


def _states(r: Any) -> list[tuple[str, str]]:
    """Name and unit of the variables of the state."""
    return [(f"{f.name}_{j}" if f.size > 1 else f.name, f.unit) for f in r.model.layout for j in range(f.size)]


def _kinds(r: Any) -> Iterator[Item]:
    kinds = {"forecast": r.run.forecast, "analysis": r.run.analysis, "smoothed": r.run.smoothed}
    for kind, moments in kinds.items():
        if kind != "smoothed" or r.problem.settings.smooths:
            yield Item(moments, {"kind": kind}, kind)


SCOPES = {"kind": _kinds}
BARE = UnitRule("its own: coordinate `units`", lambda _, item: {}, ())
READ = UnitRule("its own: coordinate `observation_units`", BARE.attributes, ())
NAME = UnitRule("", BARE.attributes, ())
EACH = When("errors that differ in time", lambda r, _: r.series.std.ndim == 2)
ALIKE = When("errors that do not", lambda r, _: r.series.std.ndim == 1)
CORRELATED = When("correlated errors", lambda r, _: r.series.correlation is not None)
WEIGHTED = When("a particle filter", lambda r, _: bool(np.isfinite(r.run.effective).any()))

SERIES: Table = (
    Declared("observations", OBSERVATION, "observations", lambda r: r.series.values, READ),
    Declared("observation_std", OBSERVATION, "std of the observation errors", lambda r: r.series.std, READ, EACH),
    Declared("observation_std", "observation", "std of the observation errors", lambda r: r.series.std, READ, ALIKE),
    Declared("observation_correlation", "observation observation_column", "correlation of the observation errors",
             lambda r: r.series.correlation.matrix, when=CORRELATED),
    Declared("predicted_mean", OBSERVATION, "forecast of the observation", lambda r: r.run.predicted.mean, READ),
    Declared("predicted_std", OBSERVATION, "standard deviation of that forecast", lambda r: r.run.predicted.std, READ),
    Declared("normalised_innovation", OBSERVATION, "innovation over its expected standard deviation",
             lambda r: r.normalised),
    Declared("rank", OBSERVATION, "place of the observation among forecast members, observation errors added, 0 to 1",
             lambda r: r.run.ranks),
)  # fmt: skip
MOMENTS: Table = (
    Declared("{kind}_mean", STATE, "mean of the {label} ensemble", lambda _, i: i.held.mean, BARE),
    Declared("{kind}_std", STATE, "standard deviation of the {label} ensemble", lambda _, i: i.held.std, BARE),
)
RUN: Table = (
    Declared("iterations", "time", "forecasts of the window", lambda r: r.run.iterations),
    Declared("effective", "time", "members that the weights leave, 1 / sum of their squares",
             lambda r: r.run.effective, when=WEIGHTED),
)  # fmt: skip
RUN_ATTRIBUTES = (
    Attribute("Conventions", "the conventions that the file follows", lambda r: "CF-1.10, ACDD-1.3"),
    Attribute("seed", "seed", lambda r: r.seed),
    Attribute("forward_runs", "runs of one member over a window", lambda r: r.run.forward_runs),
    Attribute("members_lost", "members that failed", lambda r: len(r.run.failures)),
    Attribute("members_lost_why", "the reasons, one a line", lambda r: "\n".join(r.run.failures)),
    Attribute("warnings", "one a line", lambda r: "\n".join(r.warnings)),
)


def _coordinate(name: str, dims: str, meaning: str, values: Callable[[Any], Any], unit: UnitRule = NAME) -> Declared:
    return Declared(name, dims, meaning, values, unit, fill=False)


def _columns(r: Any) -> list[Observable]:
    """The observable of each column of the readings; of a field the place, or its number, stands behind its name."""
    named = {observable.name: observable for observable in r.problem.observables}
    names = [name.split(" at ")[0] for name in r.series.names]
    return [named[name if name in named else name.rpartition("_")[0]] for name in names]


READING_COORDINATES: Table = (
    _coordinate("observation", "observation", "what was observed", lambda r: text(r.series.names)),
    _coordinate("observation_units", "observation", "unit of the observation",
                lambda r: text(o.unit for o in _columns(r))),
)  # fmt: skip
STATE_COORDINATES: Table = (
    _coordinate("state", "state", "variable of the state", lambda r: text(name for name, _ in _states(r))),
    _coordinate("units", "state", "unit of the variable", lambda r: text(unit for _, unit in _states(r))),
)


# Of data

MODEL_TIME = UnitRule("time of the model", lambda r, _: {"units": r.model.time_unit})
CLOCK = UnitRule(
    MODEL_TIME.words, lambda r, _: {"units": r.model.time_unit, "display_units": r.model.time_display_unit}
)


def _state_read(observable: Observable, model: ForwardModel) -> str:
    """The variable of the state that an observable reads as it is; "" where it is more than that."""
    name = observable.operator.name if isinstance(observable.operator, StateField) else ""
    single = name in model.layout.names and model.layout[name].stop - model.layout[name].start == 1
    return name if single else ""


def _states_shown(r: SeriesResult) -> list[Shown]:
    """What says how each variable of the state is shown: the observable that reads it, a parameter, its field of the
    state, or its name."""
    model = r.model
    known: dict[str, Shown] = {shown.name: shown for shown in (*model.layout.fields, *model.parameters)}
    known |= {_state_read(o, model): o for o in _columns(r)}
    return [known.get(name) or Field(name, unit=unit) for name, unit in _states(r)]


def _positive(problem: SeriesProblem) -> Any:
    coordinates = problem.settings.coordinates
    flags = np.zeros(problem.start.model.layout.size, dtype=np.int8)
    flags[list(coordinates.logarithms)] = 1
    flags[[column for column, term in coordinates.terms if term.transform == "lognormal"]] = 1
    return flags


def _members(run: SequentialState, n_members: int) -> Array:
    """(T, N, n), those that were lost NaN at the end."""
    rows = np.full((len(run.kept), n_members, run.analysis.mean.shape[1]), np.nan)
    for row, (_, members) in zip(rows, run.kept, strict=True):
        row[: len(members)] = members
    return rows


SEQUENCE: Table = (
    Declared("evidence", "time", "log density of the observations given those before", lambda r: r.run.evidence),
    Declared("members", "member_time member state", "analysis ensemble",
             lambda r: _members(r.run, r.problem.members), BARE),
)  # fmt: skip
SEQUENCE_COORDINATES: Table = (
    _coordinate("time", "time", "observation time", lambda r: r.series.times, CLOCK),
    *STATE_COORDINATES,
    _coordinate("display_units", "state", "unit of the variable in reports",
                lambda r: text(s.display_unit for s in _states_shown(r))),
    _coordinate("symbol", "state", "how the variable is written in reports",
                lambda r: text(s.symbol for s in _states_shown(r))),
    _coordinate("positive", "state", "1: the ensemble holds its logarithm", lambda r: _positive(r.problem)),
    *READING_COORDINATES,
    _coordinate("observation_display_units", "observation", "unit of the observation in reports",
                lambda r: text(o.display_unit for o in _columns(r))),
    _coordinate("observation_state", "observation", "variable of the state that was observed",
                lambda r: text(_state_read(o, r.model) for o in _columns(r))),
    _coordinate("member_time", "member_time", "times of the members that are kept",
                lambda r: r.series.times[[k for k, _ in r.run.kept]], MODEL_TIME),
)  # fmt: skip
SEQUENCE_ATTRIBUTES = (
    Attribute("title", "what the file is", lambda r: "Sequential assimilation of a series"),
    Attribute("data_set", "name of the data set", lambda r: r.problem.name),
    Attribute("parameters", "estimated parameters",
              lambda r: ", ".join(r.problem.start.prior.names if r.problem.start.prior else ())),
    Attribute("members", "members", lambda r: r.problem.members),
    Attribute("log_evidence", "ln p(y)", lambda r: r.log_evidence),
    Attribute("without_evidence", 'why there is none, or ""', lambda r: r.problem.without_evidence),
)  # fmt: skip


# Of a twin experiment


def _score(what: str) -> UnitRule:
    def attributes(r: TwinResult, item: Item) -> dict[str, Any]:
        unit = _states(r)[int(np.argmax(r.experiment.dynamic))][1]
        return {"units": unit, MEAN: getattr(r.scores[item.label], f"mean_{what}")}

    return UnitRule("that of the state", attributes)


TWIN: Table = (Declared("truth", STATE, "state of the truth", lambda r: r.truth, BARE),)
SCORES: Table = (
    Declared("{kind}_rank", STATE, "share of the {label} members below the truth", lambda _, i: i.held.rank),
    Declared("{kind}_rmse", "time", "RMSE of the {label} mean", lambda r, i: r.scores[i.label].rmse, _score("rmse")),
    Declared("{kind}_spread", "time", "spread of the {label}", lambda r, i: r.scores[i.label].spread,
             _score("spread")),
)  # fmt: skip
TWIN_COORDINATES: Table = (
    _coordinate("time", "time", "observation time", lambda r: r.series.times, MODEL_TIME),
    *STATE_COORDINATES,
    *READING_COORDINATES,
    _coordinate("dynamic", "state", "1: counts in RMSE and spread", lambda r: r.experiment.dynamic.astype(np.int8)),
)
TWIN_ATTRIBUTES = (
    Attribute("title", "what the file is", lambda r: "Twin experiment"),
    Attribute("members", "members", lambda r: r.experiment.members),
    Attribute("burn_in", "cycles that do not count in averages", lambda r: r.experiment.burn_in),
)


TABLES = {"sequence.nc": (*SERIES, *MOMENTS, *RUN, *SEQUENCE), "twin.nc": (*TWIN, *SERIES, *RUN, *MOMENTS, *SCORES)}
COORDINATES = {"sequence.nc": SEQUENCE_COORDINATES, "twin.nc": TWIN_COORDINATES}
ATTRIBUTES = {"sequence.nc": (*SEQUENCE_ATTRIBUTES, *RUN_ATTRIBUTES), "twin.nc": (*TWIN_ATTRIBUTES, *RUN_ATTRIBUTES)}


# summary.csv


def estimates(result: SeriesResult) -> list[tuple[str, float, float, str]]:
    """(name, mean, std, unit) of what is uncertain in the analysis at the last time, in display units."""
    displays = (shown.display_unit for shown in _states_shown(result))
    states = ((*state, display) for state, display in zip(_states(result), displays, strict=True))
    last = result.run.analysis
    return list(uncertain(states, last.mean[-1], last.std[-1]))


def uncertain(states: Iterable[Sequence[str]], mean: Array, std: Array) -> Iterator[tuple[str, float, float, str]]:
    """Name, mean, std and the unit they are shown in of ``states`` (name, unit, that unit) that are not just known."""
    for (name, unit, display), *numbers in zip(states, mean.tolist(), std.tolist(), strict=True):
        value, spread = (float(convert(number, unit, display)) for number in numbers)
        if spread > CERTAIN * abs(value):
            yield name, value, spread, display


def sequence_csv(result: SeriesResult) -> str:
    rows = [[name, f"{mean:.8g}", f"{std:.6g}", unit] for name, mean, std, unit in estimates(result)]
    return csv_text([["variable", "mean", "std", "unit"], *rows])


def twin_csv(result: TwinResult) -> str:
    """RMSE, spread and iterations, averaged after the burn-in, as CSV."""
    counted = slice(result.experiment.burn_in, None)
    forecasts = f"{np.mean(result.run.iterations[counted]):.4g}"
    lines = [["estimate", "rmse", "spread", "cycles", "forecasts_per_cycle"]]
    for name, score in result.scores.items():
        cycles = str(np.isfinite(score.rmse[counted]).sum())
        lines.append([name, f"{score.mean_rmse:.6g}", f"{score.mean_spread:.6g}", cycles, forecasts])
    return csv_text(lines)
