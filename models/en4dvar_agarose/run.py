"""The study: both routes on every gel and model, then population and model comparison.

The results that a study or a sweep has computed so far are on disk, so that one that was killed continues to the same
bits. Kept are the chunks of the sweeps, the draws of each data set and the fits of one gel; what is quick, En4D-Var and
the populations, is computed again. What decides the numbers is kept with them, and a study is continued only where that
agrees.
"""

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import yaml

from en4dvar.assembly.build import build, estimated_files
from en4dvar.config import Config
from en4dvar.config.document import yaml_text
from en4dvar.estimation.assimilate import assimilate
from en4dvar.estimation.joint import Single, estimate_jointly, sharing
from en4dvar.estimation.population import Population, population_of
from en4dvar.estimation.population.campaign import FEWEST_SETS
from en4dvar.estimation.population.own import OwnDraws, own_draws
from en4dvar.executor import Executor, choose_executor, one_blas_thread
from en4dvar.model.forward import ForwardModel
from en4dvar.plumbing.errors import TooFewMembersError, retold
from en4dvar.priors.prior import Prior, own_seed
from en4dvar.problem import InverseProblem
from en4dvar.results.checkpoint import FOLDER, CheckpointError, digest, read_checkpoint, write_checkpoint
from en4dvar.results.provenance import Identity, identity, source_digest
from en4dvar.runs.engine import directory_mode
from en4dvar.runs.interrupt import tell_interrupt, terminate_as_interrupt
from en4dvar.runs.rundir import RunDirectory
from en4dvar.sampling.sweep import SweepResult, SweepSettings, run_sweep
from en4dvar_agarose.fits import HYPER, UNSURE, Comparison, Fit, OneByOne, OneGel, Study, read_truth
from en4dvar_agarose.paper import TABLE_2, Model
from en4dvar_agarose.settings import StudyPlan, named
from en4dvar_bubble.model import BubbleModel

D = TypeVar("D")
IDENTITY = f"{FOLDER}/study"


class StudyCheckpoints:
    """Results of the study ``key`` in ``directory``."""

    def __init__(self, directory: RunDirectory, key: str):
        self.directory, self.key = directory, key

    @classmethod
    @contextmanager
    def open(
        cls, folder: Path, force: bool, resume: bool, who: Identity, files: Sequence[str]
    ) -> "Iterator[StudyCheckpoints]":
        """For a new study in ``folder``, which will write ``files``, or the one that is there; complete as this ends.

        Raises :class:`OutputError`: it cannot be written, or the one there would have other numbers, and says why.
        """
        with (
            terminate_as_interrupt(),
            RunDirectory.open(folder, directory_mode(force, resume), files) as directory,
            tell_interrupt(lambda: f"finished parts are kept in {folder}"),
        ):
            who.require_same(read_checkpoint(directory.at(IDENTITY), "study", Identity), directory.path)
            directory.claim(*files)
            directory.folder(FOLDER)
            write_checkpoint(directory.at(IDENTITY), "study", who)
            yield cls(directory, digest(f"{who.settings}{who.data}".encode()))
            directory.publish()

    def sweep(self, *words: str) -> Path:
        folder = self.directory.folder(f"{FOLDER}/{named('sweep', *words)}")
        for half_written in folder.glob(".*.tmp"):  # of a process that was killed
            half_written.unlink()
        return folder

    def of(self, kind: type[D], compute: Callable[[], D], *words: str) -> D:
        """The dataclass kept under ``words``, or what ``compute`` gives, then kept."""
        path = self.directory.at(f"{FOLDER}/{named(kind.__name__, *words)}")
        try:
            result = read_checkpoint(path, self.key, kind)
        except CheckpointError:  # damaged: computed again
            result = None
        if result is None:
            result = compute()
            write_checkpoint(path, self.key, result)
        return result


def identity_of(seed: int, sweep: SweepSettings, configs: Mapping[str, Config]) -> Identity:
    """What decides the numbers of a study: its seed and effort, its configurations by name, readings, software and
    sources.
    """
    common: dict[str, Any] = {"software": {}, "sources": {"en4dvar_agarose": source_digest("en4dvar_agarose")}}
    each: dict[str, dict[str, Any]] = {}
    data: list[tuple[str, str]] = []
    for name, config in configs.items():
        own = identity(config.resolved, config.model, estimated_files(config))
        each[name] = yaml.safe_load(own.settings)
        for key, values in common.items():
            values.update(each[name].pop(key))
        data += [(f"{name}, {dataset}", digest) for dataset, digest in own.data]
    settings = {"seed": seed, "sweep": asdict(sweep), "configurations": each, **common}
    return Identity(yaml_text(settings), tuple(data))


Say = Callable[[str], None]
SHARED = ("G", "alpha", "mu")  # properties of the gel; R0 and t_s belong to the bubble
POPULATION = ("G", "alpha", "mu", "R0")
COMPARED: tuple[Model, Model] = ("nh", "qlkv")


def run_study(plan: StudyPlan, workers: int, say: Say, keep: StudyCheckpoints) -> Study:
    """Compute everything; the truth of a twin is read last and enters no estimate.

    ``keep``: where sweeps and populations are kept as they are done, and found by a study that continues. Raises
    DataError, ConfigError and TooFewMembersError as the routes do.
    """
    problems = {(gel, m): build(c) for gel, models in plan.configs.items() for m, c in models.items()}
    model = next(iter(problems.values()))[0].model
    with choose_executor(model, workers=workers) as executor:
        work = _Parts(plan, executor, say, keep, {})
        sweeps = work.sweeps(problems)
        fits: dict[str, dict[Model, Fit]] = {gel: {} for gel in plan.configs}
        for (gel, m), sets in problems.items():
            fits[gel][m] = work.analysed(Fit(gel, m, sets, sweeps[gel, m], ()))
        narrow = {gel: fit for gel, models in fits.items() if (fit := work.narrow(models.get("qlkv")))}
        populations, comparisons = work.pooled(fits)
    truth = read_truth(plan.truth) if plan.truth else {}
    return Study(plan, fits, populations, comparisons, truth, work.seconds, narrow)


@dataclass(frozen=True)
class _Parts:
    plan: StudyPlan
    executor: Executor
    say: Say
    keep: StudyCheckpoints
    seconds: dict[str, float]

    def tell(self, words: str, part: str, began: float) -> None:
        """Say what is done, and add the time that it took to that of its part of the study."""
        spent = time.perf_counter() - began
        self.seconds[part] = self.seconds.get(part, 0.0) + spent
        self.say(f"{words} in {spent:.1f} s")

    def sweeps(
        self, problems: Mapping[tuple[str, Model], Sequence[InverseProblem]]
    ) -> dict[tuple[str, Model], SweepResult]:
        """One design serves the data sets of one model with the same values fixed."""
        groups: dict[object, list[tuple[str, Model]]] = {}
        for (gel, model), sets in problems.items():
            groups.setdefault((model, tuple(sorted(sets[0].fixed.items()))), []).append((gel, model))
        sweeps = {}
        for keys in groups.values():
            every, began = one_model([p for key in keys for p in problems[key]]), time.perf_counter()
            folder, earliest = self.keep.sweep(*keys[0]), earliest_reading(every[0].model)
            result = run_sweep(every, self.plan.sweep, self.plan.seed, self.executor, folder, earliest=earliest)
            first = 0
            for key in keys:
                sweeps[key] = result.part(slice(first, first + len(problems[key])))
                first += len(problems[key])
            words = f"sweep of {result.trajectories} trajectories against {len(every)} data sets"
            self.tell(f"{' and '.join(map(' '.join, keys))}: {words}", "sweep", began)
        return sweeps

    def analysed(self, fit: Fit, prior: str = "") -> Fit:
        """With the analyses of its problems; ``prior`` says in what it is not that of the configuration."""
        config, began = self.plan.configs[fit.gel][fit.model], time.perf_counter()
        seeds = (own_seed(config.seed, name) for name in fit.names)
        analyses = tuple(
            assimilate(p, config.assimilation, seed, self.executor) for p, seed in zip(fit.problems, seeds, strict=True)
        )
        words = f"{fit.gel} {fit.model}{prior}: En4D-Var of {len(fit.problems)} data sets"
        self.tell(words, "en4dvar", began)
        return replace(fit, analyses=analyses)

    def narrow(self, fit: Fit | None) -> Fit | None:
        """With a prior on R0 as narrow as printed; None where the paper prints none, or R0 is not estimated."""
        printed = TABLE_2.get(fit.gel, {}).get(fit.model, {}).get("R0") if fit else None
        if fit is None or printed is None or not fit.estimated("R0"):
            return None
        relative = printed[1] / printed[0]
        terms = tuple(replace(t, std=relative) if t.parameter.name == "R0" else t for t in fit.prior.terms)
        narrow = replace(fit, problems=tuple(replace(p, prior=Prior(terms)) for p in fit.problems))
        return self.analysed(narrow, ", R0 as narrow as printed")

    def pooled(self, fits: Mapping[str, dict[Model, Fit]]) -> tuple[dict[str, Population], dict[str, Comparison]]:
        """Populations of the general law and comparisons with the neo-Hookean, a gel each; ``fits`` get evidences."""
        populations, comparisons, began = {}, {}, time.perf_counter()
        for gel, models in fits.items():
            for m, fit in models.items():
                models[m] = replace(fit, sampled=self._sampled(fit))
            estimates = {m: self._population(models[m]) for m in COMPARED if m in models}
            if (general := estimates.get("qlkv")) is not None:
                populations[gel] = general
            if len(estimates) == len(COMPARED):
                comparisons[gel] = self._comparison(models, estimates)
        self.tell("population and model comparison", "population", began)
        return populations, comparisons

    def _sampled(self, fit: Fit) -> tuple[OwnDraws, ...]:
        def compute() -> OneByOne:
            each = zip(fit.problems, fit.starts, strict=True)
            with one_blas_thread(), retold(ValueError, TooFewMembersError, "no evidence: "):
                return OneByOne(tuple(own_draws(p, start, self.plan.seed, self.executor) for p, start in each))

        return self.keep.of(OneByOne, compute, fit.gel, fit.model).sampled

    def _population(self, fit: Fit) -> Population | None:
        """None with fewer than 3 data sets."""
        if len(fit.problems) < FEWEST_SETS:
            return None
        names = [name for name in POPULATION if fit.estimated(name)]
        return population_of(
            fit.problems, list(fit.starts), names, self.plan.seed, kept=fit.sampled, executor=self.executor, hyper=HYPER
        )

    def _comparison(self, models: Mapping[Model, Fit], populations: Mapping[Model, Population | None]) -> Comparison:
        nh, general = (models[m] for m in COMPARED)
        pooled = {
            m: math.nan if population is None else population.log_evidence for m, population in populations.items()
        }
        one_nh, one_general = (
            self.keep.of(OneGel, partial(self._one_gel, fit), fit.gel, fit.model) for fit in (nh, general)
        )
        return Comparison(
            single=general.log_evidence - nh.log_evidence,
            population=pooled["qlkv"] - pooled["nh"],
            shared=one_general.log_evidence - one_nh.log_evidence,
            chi2=(one_nh.chi2_per_observation, one_general.chi2_per_observation),
            doubts=tuple(code for code in UNSURE if code in one_nh.doubts + one_general.doubts),
        )

    def _one_gel(self, fit: Fit) -> OneGel:
        """All bubbles of a gel with the same material parameters."""
        names = [name for name in SHARED if fit.estimated(name)]
        singles = [Single.of_physical(fit.prior, a.survivors, a.centre) for a in fit.analyses]
        settings = self.plan.configs[fit.gel][fit.model].assimilation
        joint = estimate_jointly(sharing(fit.problems, names), settings, self.plan.seed, self.executor, singles)
        readings = np.array([len(p.observations) for p in fit.problems])
        doubts = tuple(c.code for c in joint.cautions if c.code in UNSURE)
        return OneGel(joint.log_evidence, float(joint.chi2 @ readings / readings.sum()), doubts)


def one_model(problems: Sequence[InverseProblem]) -> list[InverseProblem]:
    """With the first one's model where theirs is the same, as that of two configurations that differ in their data."""
    first = problems[0].model
    return [replace(p, model=first) if _same(first, p.model) else p for p in problems]


def _same(a: ForwardModel, b: ForwardModel) -> bool:
    """A law has no settings but its parameters: its class is all."""
    if not (isinstance(a, BubbleModel) and isinstance(b, BubbleModel) and type(a.law) is type(b.law)):
        return a is b
    return all(getattr(a, f.name) == getattr(b, f.name) for f in fields(a) if f.name != "law")


def earliest_reading(model: ForwardModel) -> float:
    """A released bubble is symmetric in time; a driven one has no path before its start."""
    return -math.inf if isinstance(model, BubbleModel) and model.start == "laser" else 0.0
