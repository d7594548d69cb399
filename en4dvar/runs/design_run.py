"""The kind of run that plans experiments: every design of a file evaluated, kept as it ends, and reported."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from en4dvar.config import Config, resolve
from en4dvar.config.context import parse_spread
from en4dvar.config.document import Document, document_from, override
from en4dvar.config.parameters import Uncertain
from en4dvar.estimation.design.evaluate import Evaluated, Method, evaluate
from en4dvar.estimation.design.planned import Planned
from en4dvar.executor import Executor
from en4dvar.inputs.asked import DataFile
from en4dvar.plumbing.errors import ConfigError, En4dvarError, retold
from en4dvar.plumbing.units import UnitError
from en4dvar.plumbing.user_code import reason_of
from en4dvar.problem import InverseProblem
from en4dvar.results.checkpoint import FOLDER, Keeper, digest
from en4dvar.results.design_file import FILE, Asked, DesignRow, Designs, load_designs, save_designs
from en4dvar.runs.design_plan import Candidate, candidates, files_needed, planned_problem
from en4dvar.runs.engine import conduct_run
from en4dvar.runs.kind import RunKind
from en4dvar.runs.session import Session

STATE = f"{FOLDER}/designs"
CHECKED = 3  # best designs whose linearised information is checked
AGREE = 0.1  # nats


@dataclass(frozen=True)
class Done:
    """What came of a candidate: its number, ``method``, one evaluation for each number of experiments, or why none."""

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
    on_design: Callable[[int, int], None] | None = None,
    command: str = "",
) -> tuple[Designs, Path]:
    """Evaluate the designs of a configuration. Returns what was found and the directory it lies in.

    ``after``: a finished run (or a file of members), whose posterior is the prior of what is asked: what is next?
    ``on_design`` is called with how many designs are done, and of how many.

    Raises
    ------
    ConfigError, DataError: the file cannot be used, or none of its designs. OutputError: the directory cannot.
    """
    document, base = document_from(source)
    document = override(document, overrides or {})
    if after is not None:
        document = override(document, _known(document, base, after))
    every = list(candidates(document, base))
    config = every[0].config
    config = replace(config, directory=out or config.directory.with_name(f"{config.directory.name}_design"))
    return conduct_run(DesignKind(config, every, on_design), force, resume, command), config.directory


@dataclass(frozen=True)
class DesignKind(RunKind[Designs]):
    """A configuration whose experiments are yet to be made: ``every`` design is a unit of work."""

    name = "design"
    result = FILE
    files = (result, STATE)
    pages = ("designs.csv", "design.html")
    writer = "en4dvar.report.design:write_design"

    config: Config
    every: Sequence[Candidate]
    tell: Callable[[int, int], None] | None = None

    @cached_property
    def data(self) -> Mapping[str, DataFile]:
        return files_needed(self.config)

    @cached_property
    def asked(self) -> Asked:
        """What is asked. Raises :class:`ConfigError`, :class:`DataError`."""
        config = self.config
        problem = planned_problem(config)
        terms = {term.parameter.name: term.parameter for term in problem.prior.terms}
        design, planned = config.design, Planned(problem, config.design.about, config.design.common)
        about = [terms[name] for name in planned.about]
        others = [terms[name] for name in planned.names[planned.asked :]] if design.wanted else []
        _wanted(config, problem)
        model, seen = config.model, problem.observable
        return Asked(
            parameters=tuple(p.name for p in about),
            symbols=tuple(p.symbol for p in about),
            labels=tuple(p.label for p in about),
            units=tuple((p.unit, p.display_unit) for p in about),
            knobs=tuple(config.design.knobs),
            laws=tuple(config.design.laws),
            enough=config.design.enough,
            seen=seen.label,
            wanted={name: str(text) for name, text in design.wanted.items()},
            others=tuple((p.name, p.unit, p.display_unit) for p in others),
            axes=((model.time_unit, model.time_display_unit), (seen.unit, seen.display_unit)),
        )

    def check(self) -> None:
        _ = self.asked

    def kept(self) -> str:
        return f"the designs that are done are kept in {self.directory}"

    def conduct(self, run: Session, executor: Executor) -> Designs:
        work = _Work(self, run)
        work.everything(executor)
        file = run.directory.at(self.result)
        save_designs(file, work.rows(), self.asked, {**run.attributes, "name": self.config.name})
        if self.config.report:
            self.page(run.directory.work)
        return load_designs(file)


def _known(document: Document, base: Path, after: Path) -> dict[str, Any]:
    """What makes the posterior of a finished run the prior of what is asked; the rest belongs to each experiment."""
    config = resolve(document, base)
    estimated = [entry.parameter.name for entry in config.parameters if isinstance(entry, Uncertain)]
    names = (*(config.design.about or estimated), *config.design.common)
    file = after / "posterior.nc" if after.is_dir() else after
    return {"prior.ensemble": str(file.absolute()), **{f"parameters.{name}": {"prior": "ensemble"} for name in names}}


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


class _Work:
    """The candidates, what is done of them, and how the rest is decided."""

    def __init__(self, kind: DesignKind, run: Session):
        self.config, self.every, self.run, self.tell = kind.config, kind.every, run, kind.tell
        fingerprint = digest(run.identity.settings.encode())
        again = "all designs are evaluated again"
        self.done = [*(run.restore(STATE, fingerprint, tuple[Done, ...], again) or ())]  # in the order of their ends
        self.keeper = Keeper(run.directory.at(STATE), fingerprint, self.config.execution.checkpoint_every)

    def everything(self, executor: Executor) -> None:
        """Evaluate by the method asked for; ``auto`` checks the linearised information and replaces it if it is off."""
        method = self.config.design.method
        if method == "auto" and self.config.design.laws:
            method = "laplace"  # the designs are ranked by what they tell of the law, which is exact
        if method != "auto":
            self._evaluate(executor, range(len(self.every)), method)
            return
        self._evaluate(executor, range(len(self.every)), "laplace")
        gains = {d.number: d.results[0].gain for d in self._latest() if d.results}
        best = sorted(gains, key=lambda number: -gains[number])[:CHECKED]
        checked = [number for number in dict.fromkeys([0, *best]) if number in gains]
        self._evaluate(executor, checked, "nested")
        exact = {d.number: d.results[0] for d in self._latest() if d.method == "nested" and d.results}
        if any(abs(exact[n].gain - gains[n]) > AGREE + 2 * exact[n].error for n in checked if n in exact):
            self._evaluate(executor, list(gains), "nested")

    def rows(self) -> list[DesignRow]:
        """Every candidate, or number of experiments alike, in the order of the file."""
        rows = []
        for done in sorted(self._latest(), key=lambda d: d.number):
            candidate = self.every[done.number]
            for result in done.results:
                cost = candidate.config.design.price.of(result.alike, len(result.readings))
                rows.append(DesignRow(done.number, dict(candidate.settings), result, cost))
            if done.failure:
                rows.append(DesignRow(done.number, dict(candidate.settings), None, float("nan"), done.failure))
        return rows

    def _latest(self) -> list[Done]:
        """Of each candidate what came last: nested after laplace."""
        return list({d.number: d for d in self.done}.values())

    def _evaluate(self, executor: Executor, numbers: Sequence[int], method: Method) -> None:
        done = {d.number for d in self.done if d.method == method}
        left = [n for n in numbers if n not in done]
        calls = ((self.every[n], method, self.config.seed) for n in left)
        for i, outcome in executor.map(_one, calls):
            results, failure = ((), reason_of(outcome)) if isinstance(outcome, Exception) else outcome
            ended = Done(left[i], method, results, failure)
            self.done.append(ended)
            self.run.log.write(_line(ended))
            self.keeper.keep(lambda: tuple(self.done))
            if self.tell:
                self.tell(len(numbers) - len(left) + i + 1, len(numbers))
        self.keeper.write(tuple(self.done))
        if not any(d.results for d in self.done):
            raise ConfigError(f"none of the designs can be evaluated: {self.done[0].failure}")


def _one(candidate: Candidate, method: Method, seed: int) -> tuple[tuple[Evaluated, ...], str]:
    """Evaluate a candidate in a worker; the text says why it cannot be."""
    config = candidate.config
    design = config.design
    try:
        problem, laws = planned_problem(config), [planned_problem(law) for law in candidate.laws]
        sizes, alike = design.sizes, design.experiments
        choice = (design.choose.readings, design.choose.apart) if design.choose else None
        told = design.common, _wanted(config, problem)
        every = evaluate(problem, design.about, sizes, method, seed, alike, choice, laws, *told)
        costs = (design.price.of(planned.alike, len(planned.readings)) for planned in every)
        broken = [design.within.broken(len(o.readings), cost, o.beyond) for o, cost in zip(every, costs, strict=True)]
        kept = tuple(planned for planned, reason in zip(every, broken, strict=True) if not reason)
        return kept, "" if kept else broken[0]
    except En4dvarError as error:
        return (), str(error)


def _line(done: Done) -> str:
    if done.failure:
        return f"design {done.number}: {done.failure}"
    result = done.results[0]
    of = " of the law" if result.decision else f" ({result.method})"
    worth = f"{result.worth:.4g} nats ± {result.worth_error:.2g}{of}"
    return f"design {done.number}: {worth}, {result.forward_runs} runs"
