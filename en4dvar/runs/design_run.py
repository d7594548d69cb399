"""The kind of run that plans experiments: every design of a file evaluated, kept as it ends, and reported."""

import shlex
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from en4dvar.assembly.build import discrepancy_terms, inverse_plan, needed_file, problem_of
from en4dvar.assembly.reading import errors_of, read_observations, step_of
from en4dvar.config import Config, resolve
from en4dvar.config.design import Value
from en4dvar.config.document import Document, document_from, override
from en4dvar.config.parameters import Uncertain
from en4dvar.config.quantities import parse_spread
from en4dvar.data.noise import noise_of
from en4dvar.data.observations import Observations
from en4dvar.data.series import Series
from en4dvar.ensemble.forecast import forecast
from en4dvar.estimation.design.evaluate import Evaluated, Method, SampleSizes, evaluate, span_of_runs
from en4dvar.estimation.design.nested import THIN
from en4dvar.estimation.design.planned import Planned
from en4dvar.executor import Executor
from en4dvar.inputs.parts import DataFile
from en4dvar.model.state import Array
from en4dvar.plumbing.errors import ConfigError, En4dvarError, retold
from en4dvar.plumbing.hints import counted, rounded
from en4dvar.plumbing.units import UnitError
from en4dvar.problem import InverseProblem
from en4dvar.results.checkpoint import FOLDER
from en4dvar.results.design_file import FILE, Asked, DesignRow, Designs, load_designs, save_designs
from en4dvar.results.run_results import has_results, result_files
from en4dvar.results.together import POPULATION, group_folders
from en4dvar.runs.engine import KeptUnits, RunKind, Session, Tell, conduct_run

STATE = f"{FOLDER}/designs"
CHECKED = 3  # best designs whose linearised information is checked
AGREE = 0.1  # nats
CHEAP = "'--set design.method=laplace' leaves this out"


@dataclass(frozen=True)
class Candidate:
    """A design: what its knobs are set to, and the configuration that this makes. Without settings: as in the file.
    ``laws``: the same configuration with each of the laws that are to be told apart.
    """

    settings: Mapping[str, Value]
    config: Config
    laws: tuple[Config, ...] = ()

    @classmethod
    def of(cls, settings: Mapping[str, Value], document: Document, base: Path) -> "Candidate":
        """From the document that the settings make. Raises :class:`ConfigError`."""
        config = resolve(document, base)
        laws = []
        for name, keys in config.design.laws.items():
            places = dict.fromkeys(keys, str(document.fault(("design", "laws", name), "")))
            laws.append(resolve(override(document, keys, places=places), base))
        return cls(settings, config, tuple(laws))


@dataclass(frozen=True)
class Done:
    """What came of a candidate: its number, ``method``, one evaluation for each number of experiments, why not all."""

    number: int
    method: str
    results: tuple[Evaluated, ...]
    failure: str = ""


def run_design(
    source: str | Path | Mapping[str, Any],
    *,
    overrides: Mapping[str, Any] | None = None,
    after: Path | None = None,
    out: Path | None = None,
    force: bool = False,
    resume: bool = False,
    on_design: Tell | None = None,
    on_cost: Callable[[str], None] | None = None,
    command: str = "",
) -> tuple[Designs, Path]:
    """Evaluate the designs of a configuration. Returns what was found and the directory it lies in.

    ``after``: a finished run (or a file of members), whose posterior is the prior of what is asked: what is next? Of a
    population what it says of its next data set.
    ``on_design`` is called with how many designs are done, and of how many; ``on_cost`` with what is said of the cost.

    Raises :class:`ConfigError`, :class:`DataError`: the file cannot be used, or none of its designs.
    :class:`OutputError`: the directory cannot.
    """
    document, base = document_from(source, overrides)
    if after is not None:
        known = _known(document, base, after)
        document = override(document, known, "--after", dict.fromkeys(known, "--after"))
    every = list(candidates(document, base))
    config = every[0].config
    config = replace(config, directory=out or config.directory.with_name(f"{config.directory.name}_design"))
    return conduct_run(DesignKind(config, every, on_design, on_cost), force, resume, command), config.directory


@dataclass(frozen=True)
class DesignKind(RunKind[Designs]):
    """A configuration whose experiments are yet to be made: ``every`` design is a unit of work."""

    name = "design"
    units = "designs that are done"
    result = FILE
    files = (result, STATE)
    pages = ("designs.csv", "design.html")
    writer = "en4dvar.report.design:write_design"

    config: Config
    every: Sequence[Candidate]
    tell: Tell | None = None
    tell_cost: Callable[[str], None] | None = None

    @cached_property
    def data(self) -> Mapping[str, DataFile]:
        return needed_file(self.config, _planned_times(self.config))

    @cached_property
    def planned(self) -> Planned:
        """The design of the file itself. Raises :class:`ConfigError`, :class:`DataError`."""
        return Planned(planned_problem(self.config), self.config.design.about, self.config.design.common)

    @cached_property
    def asked(self) -> Asked:
        """What is asked. Raises :class:`ConfigError`, :class:`DataError`."""
        config, design, planned = self.config, self.config.design, self.planned
        problem = planned.problem
        terms = {term.parameter.name: term.parameter for term in problem.prior.terms}
        about = [terms[name] for name in planned.about]
        others = [terms[name] for name in planned.names[planned.asked :]] if design.wanted else []
        _wanted(config, problem)
        model, seen = config.model, problem.observable
        return Asked(
            parameters=tuple(p.name for p in about),
            symbols=tuple(p.symbol for p in about),
            labels=tuple(p.label for p in about),
            units=tuple((p.unit, p.display_unit) for p in about),
            knobs=tuple(design.knobs),
            laws=tuple(design.laws),
            enough=design.enough,
            seen=seen.label,
            wanted={name: str(text) for name, text in design.wanted.items()},
            others=tuple((p.name, p.unit, p.display_unit) for p in others),
            other_symbols=tuple(p.symbol for p in others),
            axes=((model.time_unit, model.time_display_unit), (seen.unit, seen.display_unit)),
        )

    def check(self) -> None:
        _ = self.asked

    def conduct(self, run: Session, executor: Executor) -> Designs:
        kept = KeptUnits(run, STATE, Done, "all designs are evaluated again")
        self._evaluate_all(kept, executor)
        file = run.directory.at(self.result)
        save_designs(file, [*self._rows(kept.done.values())], self.asked, {**run.attributes, "name": self.config.name})
        return load_designs(file)

    def _evaluate_all(self, kept: KeptUnits[Done], executor: Executor) -> None:
        """By the method asked for; ``auto`` checks the linearised information and replaces it if it is off. A nested
        estimate of few effective draws is no check: the linearised one stands and says so.
        """
        every, method = range(len(self.every)), self.config.design.method
        auto: Method = "laplace" if method == "auto" else method
        cost = f"cost: {self._cost(every, auto)}"
        checks = min(len(every), 1 + CHECKED)
        if method == "auto" and not self.config.design.laws:
            cost += (
                f"; then {self._cost(range(checks), 'nested')}, as a check, and of all if that finds them off; {CHEAP}"
            )
        self._say(kept, cost)
        if method != "auto" or self.config.design.laws:  # what designs tell of the law, by which they rank, is exact
            self._evaluate(kept, executor, every, auto)
            return
        self._evaluate(kept, executor, every, "laplace")
        told = {d.number: d.results for d in kept.done.values() if d.method == "laplace" and d.results}
        best = sorted(told, key=lambda number: -told[number][0].gain)[:CHECKED]
        checked = [n for n in dict.fromkeys([0, *best]) if n in told]
        self._evaluate(kept, executor, checked, "nested")
        off = {
            d.number: n.gain - o.gain
            for d in kept.done.values() if d.method == "nested"
            for n, o in zip(d.results, told[d.number], strict=False)
            if n.thin <= THIN and abs(n.gain - o.gain) > AGREE + 2 * n.error
        }  # fmt: skip
        if off:
            by = ", ".join(f"of design {number} by {-difference:+.2g} nats" for number, difference in off.items())
            cost = self._cost([n for n in told if n not in checked], "nested")
            self._say(kept, f"the linearised information is off, {by}; cost: {cost}; {CHEAP}")
            self._evaluate(kept, executor, list(told), "nested")

    def _say(self, kept: KeptUnits[Done], words: str) -> None:
        kept.log(words)
        if self.tell_cost:
            self.tell_cost(words)

    def _cost(self, numbers: Sequence[int], method: Method) -> str:
        """What it takes to evaluate so many designs, in words; they are taken to be as the first."""
        design = self.config.design
        runs = span_of_runs(self.planned, design.part(SampleSizes), method, design.choose is not None, len(design.laws))
        return f"{counted(len(numbers), 'design')} by {method}, about {rounded(*runs)} forward runs each"

    def _evaluate(self, kept: KeptUnits[Done], executor: Executor, numbers: Sequence[int], method: Method) -> None:
        calls = {f"{method} {n}": (n, self.every[n], method, self.config.seed) for n in numbers}
        kept.work(
            executor, _one, calls, self.tell, line=lambda _, done: _line(done),
            failed=lambda number, *_, reason: Done(number, method, (), reason),
        )  # fmt: skip
        every = list(kept.done.values())
        if not any(d.results for d in every):
            raise ConfigError(f"none of the designs can be evaluated: {every[0].failure}")

    def _rows(self, done: Iterable[Done]) -> Iterator[DesignRow]:
        """Every candidate, or number of experiments alike, in the order of the file."""
        for d in sorted(_latest(done), key=lambda d: d.number):
            settings, price = dict(self.every[d.number].settings), self.every[d.number].config.design.price
            for result in d.results:
                yield DesignRow(d.number, settings, result, price.of(result.alike, len(result.readings)))
            if d.failure:
                yield DesignRow(d.number, settings, None, float("nan"), d.failure)


def _latest(done: Iterable[Done]) -> list[Done]:
    """Of each candidate what came last: nested after laplace, which stays where the nested one rests on few draws."""
    latest: dict[int, Done] = {}
    for d in done:
        before = latest.get(d.number)
        if before and any(result.thin > THIN for result in d.results):
            pairs = zip(before.results, d.results, strict=True)
            d = replace(before, results=tuple(replace(old, thin=new.thin) for old, new in pairs))
        latest[d.number] = d
    return list(latest.values())


def _known(document: Document, base: Path, after: Path) -> dict[str, Any]:
    """What makes the posterior of a finished run the prior of what is asked; the rest belongs to each experiment."""
    config = resolve(document, base)
    estimated = [entry.parameter.name for entry in config.parameters if isinstance(entry, Uncertain)]
    names, own = (*(config.design.about or estimated), *config.design.common), []
    correlated = document.data.get("prior_correlation") or ()
    for k, entry in enumerate(correlated):
        taken = [name for name in entry["between"] if name in names]
        if taken and len(taken) < len(entry["between"]):
            words = f"--after takes {', '.join(taken)} from {after}; name the others under design.common, too,"
            raise ConfigError([document.fault(("prior_correlation", k), f"{words} or leave this correlation out")])
        own += [] if taken else [entry]
    return {
        "prior.ensemble": str(_members_of(after).absolute()),
        **{f"parameters.{name}": {"prior": "ensemble"} for name in names},
        **({"prior_correlation": own} if correlated else {}),
    }


def _members_of(after: Path) -> Path:
    """The file of a finished run or population that tells of the next experiment. Raises :class:`ConfigError`."""
    if not after.is_dir():
        return after
    if (after / POPULATION).exists():
        return after / POPULATION
    if groups := [shlex.quote(str(folder)) for folder in group_folders(after)]:
        raise ConfigError(f"--after {after}: several populations; give the folder of one of them: {' '.join(groups)}")
    if has_results(after) and (count := len(result_files(after))) > 1:
        raise ConfigError(
            f"--after {after}: a campaign of {count} data sets without a population; give the run of one data set, or "
            "the folder that 'en4dvar population' makes of this one"
        )
    return after / "posterior.nc"


def _wanted(config: Config, problem: InverseProblem) -> dict[str, tuple[float, bool]]:
    """What is to be known to what: in its unit, or relative to the value. Raises :class:`ConfigError`."""
    terms, wanted = {term.parameter.name: term.parameter for term in problem.prior.terms}, {}
    for name, text in config.design.wanted.items():
        with config.document.placing("design", "wanted", name), retold(UnitError, ConfigError):
            if name not in (config.design.about or terms):
                raise ConfigError(f"{name}: not among what is asked about")
            spread = parse_spread(text, terms[name].unit)
        wanted[name] = spread.value, spread.relative
    return wanted


def _one(number: int, candidate: Candidate, method: Method, seed: int) -> Done:
    """Evaluate a candidate in a worker. Raises :class:`En4dvarError`."""
    config, design = candidate.config, candidate.config.design
    problem, laws = planned_problem(config), [planned_problem(law) for law in candidate.laws]
    sizes, alike = design.part(SampleSizes), design.experiments
    choice = (design.choose.readings, design.choose.apart) if design.choose else None
    told = design.common, _wanted(config, problem), design.method == "auto"
    every = evaluate(problem, design.about, sizes, method, seed, alike, choice, laws, *told)
    costs = (design.price.of(planned.alike, len(planned.readings)) for planned in every)
    broken = [design.within.broken(len(o.readings), cost, o.beyond) for o, cost in zip(every, costs, strict=True)]
    kept = tuple(planned for planned, reason in zip(every, broken, strict=True) if not reason)
    left = (f"{counted(o.alike, 'experiment')}: {reason}" for o, reason in zip(every, broken, strict=True) if reason)
    return Done(number, method, kept, "; ".join(left) if kept else broken[0])


def _line(done: Done) -> str:
    if not done.results:
        return f"design {done.number}: {done.failure}"
    result = done.results[0]
    of = " of the law" if result.decision else f" ({result.method})"
    worth = f"{result.worth:.4g} nats ± {result.worth_error:.2g}{of}"
    left = f"; {done.failure}" if done.failure else ""
    if result.thin > THIN:
        left = f"; {100 * result.thin:.0f} % of the simulated readings are explained by too few effective draws{left}"
    return f"design {done.number}: {worth}, {counted(result.forward_runs, 'run')}{left}"


# From a configuration to the experiments it plans


def candidates(document: Document, base: Path) -> Iterator[Candidate]:
    """The file's own design, then every combination of its knobs. Raises :class:`ConfigError`."""
    first = Candidate.of({}, document, base)
    yield first
    design = first.config.design
    if design.knobs:
        places = {knob.key: str(document.fault(("design", "knobs", name), "")) for name, knob in design.knobs.items()}
        for values in product(*(knob.values for knob in design.knobs.values())):
            settings = dict(zip(design.knobs, values, strict=True))
            overrides = {design.knobs[name].key: value for name, value in settings.items()}
            yield Candidate.of(settings, override(document, overrides, places=places), base)


def planned_problem(config: Config) -> InverseProblem:
    """The inverse problem of an experiment that is yet to be made.

    Its readings are those of the model at the centre of the prior, of which errors may be a share.

    Raises :class:`ConfigError`: no times, or something that only readings can say. :class:`DataError`: a data file that
    is needed cannot be used. :class:`En4dvarError`: the model fails at the centre of the prior.
    """
    plan, times = inverse_plan(config), _planned_times(config)
    measured = None
    for name, file in needed_file(config, times).items():
        measured = read_observations(plan, file, name, config.weights)
    if config.weights != "sum":
        raise ConfigError([config.document.fault(("assimilation", "weights"), "only 'weights: sum' is Bayesian")])
    if times is None and measured is not None:
        return problem_of(config, measured)
    assert times is not None
    for series in plan.series:
        said, error = series.data, series.data.error
        of_readings = {
            "errors in a column of the file": error.columns("", ""),
            "a covariance of readings": error.covariance is not None,
            "weights of readings": said.weights is not None,
            "places on a field": said.places is not None,
        }
        for what in (what for what, present in of_readings.items() if present):
            raise ConfigError(f"data: {what} cannot be planned at design.times; leave design.times out, or state a std")
    scale = 1.0 if measured is None else float(measured.values.max())  # for priors that refer to the largest reading
    blank = _observations(config, [np.full(len(times), scale)] * len(plan.series), times, measured)
    problem = problem_of(config, blank)
    run = forecast(problem, problem.prior.mean[None])
    if run.failures[0]:
        raise En4dvarError(f"the model fails at the centre of the prior: {run.failures[0]}")
    values = np.split(run.predictions[0], len(plan.series))
    planned = _observations(config, values, times, measured, stated=True)
    terms = (*problem.prior.terms, *discrepancy_terms(config, planned))  # the blank readings allow for none
    return replace(problem, observations=planned, prior=replace(problem.prior, terms=terms))


def _planned_times(config: Config) -> Array | None:
    return config.design.times if config.design.times is not None else config.simulate_times


def _observations(
    config: Config, values: list[Array], times: Array, measured: Observations | None, stated: bool = False
) -> Observations:
    """Readings of all series at ``times``, with the errors that the file has ``stated``."""
    plan = inverse_plan(config)
    series = [
        Series(
            observable=planned.observable,
            times=times,
            values=own,
            noise=errors_of(planned.data, times, own, {}, step_of(times))
            if stated
            else noise_of(np.ones(len(times)), np.zeros(len(times))),
            name=planned.name,
            group=planned.group,
            scalars=measured.scalars if measured else {},
            source=measured.source if measured else "",
        )
        for planned, own in zip(plan.series, values, strict=True)
    ]
    return Observations.of_series(series, plan.correlation if stated else {}, config.name)
