"""The kind of run that asks whether posteriors are calibrated: synthetic sets, each estimated, and judged by ranks.

A truth is drawn from the prior of the user's own configuration, readings from the model at that truth with the user's
own errors, at the times of the user's own data; then the set is estimated as any other. Of a correct posterior the rank
of each truth among the members is uniform (:mod:`~en4dvar.diagnosis.ranks`). The half sum of squares J_o of the
readings is a quantity like the parameters (Modrák et al. 2023, Bayesian Anal., doi:10.1214/23-BA1404). The readings
tell most of it, so that its rank among that of other readings of the same truth, as many as members, is asked too: if
the errors are as large as stated, all have one distribution, whatever the posterior and whatever R depends on.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from textwrap import indent
from typing import Any

import numpy as np
import yaml

from en4dvar.assembly.build import build_one, estimated_files
from en4dvar.config import Config, load_config, resolve
from en4dvar.config.document import document_from, override
from en4dvar.diagnosis.diagnostics import member_quantiles
from en4dvar.ensemble.forecast import Composite
from en4dvar.estimation.assimilate import assimilate
from en4dvar.executor import Executor
from en4dvar.executor.base import CommonValue
from en4dvar.inputs.parts import DataFile
from en4dvar.model.state import Array
from en4dvar.plumbing.errors import ConfigError, DataError, En4dvarError, retold
from en4dvar.plumbing.units import convert
from en4dvar.priors.prior import PriorTerm, member_stream, own_seed
from en4dvar.problem import InverseProblem
from en4dvar.report.calibration import ERRORS, FIT, LEVELS, Calibration, Judged, load_calibration, write_sets
from en4dvar.results.checkpoint import FOLDER
from en4dvar.runs.engine import KeptUnits, RunKind, Session, Tell, conduct_run, require_some

STATE = f"{FOLDER}/calibration"
ATTEMPTS = 100  # truths that the model cannot run are drawn again so often
FEWEST = 2
NOT_OF_READINGS = ("name", "seed", "assimilation", "execution", "output", "population", "design", "simulate")


def calibrate(
    config: str | Path | Mapping[str, Any],
    sets: int = 200,
    *,
    overrides: Mapping[str, Any] | None = None,
    made_with: Mapping[str, Any] | None = None,
    out: str | Path | None = None,
    force: bool = False,
    resume: bool = False,
    progress: Tell | None = None,
    command: str = "",
) -> Calibration:
    """Estimate synthetic data sets made by a configuration itself, and say whether its intervals are right.

    Writes ``calibration.csv`` and a page to ``out``, by default runs/<name>_calibration. Resumed with more ``sets`` it
    goes on; what is done stays.

    ``config`` and ``overrides``: as of :func:`en4dvar.run`. The data files say when readings are taken and how good
    they are; of several the sets take turns. ``made_with``: values for dotted keys with which the readings are made,
    though not estimated: another law, larger errors; it shows what a wrong assumption does to the intervals.
    ``progress``: called with the number of sets that are done and of all. ``force``: replace an earlier run in ``out``;
    ``resume``: continue it. ``command``: what the user typed, for the file's history.

    Raises :class:`ConfigError`, :class:`DataError`: the configuration cannot be used, ``sets`` are too few, or readings
    and those ``made_with`` other values are not at the same times. :class:`OutputError`: ``out`` cannot be used.
    :class:`En4dvarError`: all sets failed. Others as of :func:`en4dvar.run`.
    """
    if sets < FEWEST:
        raise ConfigError(f"{sets} sets tell nothing; give at least {FEWEST}, better 200")
    own = load_config(config, overrides)
    made, changed = own, ""
    if made_with:
        if idle := [key for key in made_with if key.split(".")[0] in NOT_OF_READINGS]:
            raise ConfigError(f"--made-with {idle[0]}: has no part in making readings; --set changes it")
        document, base = document_from(config, overrides)
        with retold(ConfigError, ConfigError, "with what --made-with changes: "):
            made = resolve(override(document, made_with, "--made-with"), base)
        changed = yaml.safe_dump({"made_with": {k: str(v) for k, v in made_with.items()}})
    path = Path(out) if out else own.directory.with_name(f"{own.directory.name}_calibration")
    own = replace(own, directory=path, resolved=own.resolved + indent(changed, "# "))
    return conduct_run(CalibrationKind(own, made, sets, progress, changed), force, resume, command)


@dataclass(frozen=True)
class CalibrationKind(RunKind[Calibration]):
    """A configuration, and the one readings are ``made`` with, ``changed`` (YAML); a set is a unit of work."""

    name = "calibrate"
    units = "sets that are done"
    result = "calibration.csv"
    files = (result, STATE)
    pages = ("calibration.html",)
    writer = "en4dvar.report.calibration:write_calibration"

    config: Config
    made: Config
    sets: int
    progress: Tell | None = None
    changed: str = ""

    @property
    def settings(self) -> str:
        return self.config.resolved + self.changed

    @cached_property
    def data(self) -> Mapping[str, DataFile]:
        return estimated_files(self.config)

    def check(self) -> None:
        for name, file in self.data.items():
            problem, maker = build_one(self.config, name, file), build_one(self.made, name, file)
            if problem.fields or maker.fields:
                raise ConfigError("calibrate: fields that are estimated cell by cell have no ranks to test")
            if not np.array_equal(problem.observations.times, maker.observations.times):
                raise DataError(f"{name}: the readings that are made are not at the times of those that are estimated")

    def conduct(self, run: Session, executor: Executor) -> Calibration:
        kept = KeptUnits(run, STATE, Judged, "all sets are estimated again")
        common, names = CommonValue((self.config, self.made, list(self.data.items()))), list(self.data)
        calls = {f"set {number}": (common, number) for number in range(1, self.sets + 1)}
        told = kept.work(
            executor, _judged, calls, self.progress,
            failed=lambda _, number, reason: Judged(number, names[(number - 1) % len(names)], failure=reason),
            line=lambda name, judged: f"{name}: {judged.failure or 'estimated'}",
        )  # fmt: skip
        require_some("sets", [judged.failure for judged in told])
        name, file = next(iter(self.data.items()))
        estimated = build_one(self.config, name, file).prior.parameters
        quantities = [(p.name, p.display_unit or p.unit, p.symbol) for p in estimated]
        quantities += [(name, "1", "") for name in (FIT, ERRORS)]
        write_sets(run.directory.at(self.result), quantities, told)
        return replace(load_calibration(run.directory.work), directory=self.config.directory)


def _judged(common: CommonValue[tuple[Config, Config, list[tuple[str, DataFile]]]], number: int) -> Judged:
    """Draw set ``number``, estimate it, and compare with its truth. Raises :class:`En4dvarError`."""
    config, made, files = common.value
    name, file = files[(number - 1) % len(files)]
    seed = own_seed(config.seed, f"calibration {number}")
    problem, maker = build_one(config, name, file), build_one(made, name, file)
    truth, readings = draw_set(maker, seed)
    observed = replace(problem.observations, values=readings, continued=None, name=f"{name}_{number}")
    return _compared(replace(problem, observations=observed), config, seed, truth, number, name)


def draw_set(maker: InverseProblem, seed: int) -> tuple[dict[str, float], Array]:
    """A truth, physical, by name, and readings (K,) of it. Raises :class:`En4dvarError`: the model can run none."""
    stream, composite = member_stream(seed, "truth"), Composite(maker)
    reason = ""
    for _ in range(ATTEMPTS):
        x = maker.prior.from_white(stream.standard_normal((1, len(maker.prior.names))))
        run = composite(x)
        reason = run.failures[0]
        if not reason:
            values = maker.prior.to_physical(x)[0]
            truth = {**maker.fixed, **dict(zip(maker.prior.names, map(float, values), strict=True))}
            return truth, maker.observations.noise.drawn(run.predicted[0], stream)
    raise En4dvarError(f"no truth drawn from the prior can be run in {ATTEMPTS} attempts: {reason}")


def _compared(
    problem: InverseProblem, config: Config, seed: int, truth: Mapping[str, float], number: int, name: str
) -> Judged:
    """Ranks, quantiles and z of every parameter and of J_o, as it is and among that of other readings; NaN of J_o where
    the truth lacks a parameter or lies beyond the prior.

    Members that were lost are no part of the posterior that is quoted. All sets have the ranks of as many, so that a
    rank among survivors is drawn from the places among all of them that it stands for.
    """
    prior, observations = problem.prior, problem.observations
    analysis = assimilate(problem, replace(config.assimilation, what_if=False), seed)
    members, count = prior.from_physical(analysis.survivors), len(analysis.posterior)
    known = np.array([truth.get(p.name, np.nan) for p in prior.parameters])
    x = np.vstack([members, [_coordinate(term, value) for term, value in zip(prior.terms, known, strict=True)]])
    run = Composite(problem)(x)
    physical = prior.to_physical(x)
    fits, stream = observations.cost(run.predicted), member_stream(seed, "other readings")
    if not np.allclose(physical[-1], known, atol=1e-300):  # the prior's map may end before the truth
        fits[-1] = np.nan
    at = run.predicted[-1 if np.isfinite(fits[-1]) else 0]
    others = [float(replace(observations, values=observations.noise.drawn(at, stream)).cost(at)) for _ in members]
    errors, physical[-1] = np.append(others, fits[-1]), known
    each = zip(physical.T, prior.parameters, strict=True)
    shown = np.column_stack([*(convert(v, p.unit, p.display_unit or p.unit) for v, p in each), fits, errors])
    draws, true = (white := np.column_stack([x, fits, errors]))[:-1], white[-1]
    with np.errstate(invalid="ignore", divide="ignore"):
        z = (true - draws.mean(axis=0)) / draws.std(axis=0, ddof=1)
        rank = np.where(np.isnan(true), np.nan, np.sum(draws < true, axis=0))
    if len(draws) < count:
        place = member_stream(seed, "places of ranks").uniform(size=len(rank))
        rank = np.floor((rank + place) * (count + 1) / (len(draws) + 1))
    serious = tuple(dict.fromkeys(c.code for c in analysis.cautions if c.severity == "serious"))
    numbers = np.vstack([shown[-1], member_quantiles(shown[:-1], LEVELS, axis=0), z, rank]).T
    return Judged(number, name, numbers, count, serious)


def _coordinate(term: PriorTerm, value: float) -> float:
    """Of a truth in the prior's transform: ±inf at a limit that this does not reach, or beyond; NaN of none."""
    low, high = term.range
    if low < value < high or term.transform == "normal":
        return float(term.from_physical(np.array(value)))
    return -np.inf if value <= low else np.inf if value >= high else np.nan
