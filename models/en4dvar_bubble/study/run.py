"""The study: both routes on every gel and model, then population and model comparison."""

from __future__ import annotations

import csv
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np

from en4dvar.analysis import Analysis
from en4dvar.assimilate import assimilate
from en4dvar.config.build import build
from en4dvar.diagnostics import nrmse
from en4dvar.errors import DataError
from en4dvar.executor import make_executor
from en4dvar.prior import Prior
from en4dvar.problem import InverseProblem
from en4dvar.state import Array
from en4dvar_bubble.study.evidence import Comparison, compare_laws
from en4dvar_bubble.study.keep import Keep
from en4dvar_bubble.study.one_gel import OneGel, fit_one_gel
from en4dvar_bubble.study.paper import QUANTITIES, TABLE_2, Model, Route
from en4dvar_bubble.study.population import Population, estimate_population
from en4dvar_bubble.study.set_evidence import Evidence, set_evidence
from en4dvar_bubble.study.set_runs import SetRuns
from en4dvar_bubble.study.settings import StudyPlan
from en4dvar_bubble.study.sweep import SweepResult, run_sweep

Tell = Callable[[str], None]
SHARED = ("G", "alpha", "mu")  # properties of the gel; R0 and t_s belong to the bubble
POPULATION = ("G", "alpha", "mu", "R0")
_TRUTH_UNITS = {"G_kPa": ("G", 1e3), "alpha": ("alpha", 1.0), "mu_Pa_s": ("mu", 1.0), "R0_um": ("R0", 1e-6)}


@dataclass(frozen=True)
class Fit:
    """Both routes of one model on the S data sets of one gel."""

    gel: str
    model: Model
    problems: tuple[InverseProblem, ...]
    sweep: SweepResult
    analyses: tuple[Analysis, ...]
    evidence: Evidence | None = None

    @property
    def log_evidence(self) -> Array:
        """(S,) ln p(y); by Laplace's approximation where it was not computed."""
        if self.evidence is None:
            return np.array([a.log_evidence for a in self.analyses])
        return self.evidence.log - np.array([p.observations.log_normalisation() for p in self.problems])

    @property
    def prior(self) -> Prior:
        return self.problems[0].prior

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(p.observations.name for p in self.problems)

    def values(self, route: Route, name: str) -> Array:
        """(S,) estimates of a parameter, SI: best fits of the sweep, or means of the posterior ensembles."""
        if name in self.problems[0].fixed:
            return np.full(len(self.problems), self.problems[0].fixed[name])
        if route == "sweep":
            return np.asarray(self.sweep.theta[:, [p.name for p in self.sweep.parameters].index(name)])
        return np.array([np.nanmean(a.posterior[:, self.prior.names.index(name)]) for a in self.analyses])

    def has(self, name: str) -> bool:
        return name in self.prior.names or name in self.problems[0].fixed

    def estimated(self, name: str) -> bool:
        return name in self.prior.names

    def nrmse(self, route: Route) -> Array:
        """(S,) NRMSE of the best fit, or of the centre of the posterior."""
        if route == "sweep":
            return self.sweep.nrmse
        return np.array([nrmse(a.observations.values, a.centre_predictions) for a in self.analyses])

    def summary(self, route: Route, name: str) -> tuple[float, float]:
        """NRMSE-weighted mean and standard deviation over the sets, SI; a fixed value has none."""
        if not self.estimated(name):
            return self.problems[0].fixed[name], 0.0
        weights, values = self.nrmse(route), self.values(route, name)
        mean = float(np.average(values, weights=weights))
        return mean, float(np.sqrt(np.average((values - mean) ** 2, weights=weights)))

    def members(self, name: str) -> Array:
        """(S·N,) posterior members of all sets, SI; failed ones left out."""
        j = self.prior.names.index(name)
        stacked = np.concatenate([a.posterior[:, j] for a in self.analyses])
        return stacked[np.isfinite(stacked)]

    def prior_members(self, name: str) -> Array:
        """(N,) members of the prior, SI."""
        return np.asarray(self.analyses[0].prior[:, self.prior.names.index(name)])


@dataclass(frozen=True)
class Study:
    """All that the report shows. ``truth``: data set → parameter → SI value, empty without a twin. ``narrow``: the
    general quadratic law again, with a prior on R0 as narrow as the spread that Table 2 prints.
    """

    plan: StudyPlan
    fits: Mapping[str, Mapping[Model, Fit]]
    populations: Mapping[str, Population]
    comparisons: Mapping[str, Comparison]
    truth: Mapping[str, Mapping[str, float]]
    seconds: Mapping[str, float] = field(default_factory=dict)
    narrow: Mapping[str, Fit] = field(default_factory=dict)

    def true_values(self, gel: str, name: str) -> Array:
        """(S,) true values of a gel's data sets, SI; empty where there is no truth."""
        fit = next(iter(self.fits[gel].values()))
        return np.array([self.truth[n][name] for n in fit.names if n in self.truth])

    def coverage(self, gel: str, model: Model, name: str, level: float = 0.9) -> float:
        """Share of the data sets whose central posterior interval holds the truth; NaN without a truth."""
        fit, tail = self.fits[gel][model], (1 - level) / 2
        j = fit.prior.names.index(name)
        inside = [
            low <= self.truth[a.name][name] <= high
            for a in fit.analyses
            if a.name in self.truth
            for low, high in [np.nanquantile(a.posterior[:, j], (tail, 1 - tail))]
        ]
        return float(np.mean(inside)) if inside else float("nan")


def run_study(plan: StudyPlan, workers: int = 1, tell: Tell | None = None, keep: Keep | None = None) -> Study:
    """Compute everything; the truth of a twin is read last and enters no estimate.

    ``keep``: where sweeps and populations are kept as they are done, and found by a study that continues.

    Raises
    ------
    DataError, ConfigError, TooFewMembersError: as the routes do.
    """
    say = tell or (lambda message: None)
    seconds = {}
    start = time.perf_counter()
    problems = {(gel, m): build(c) for gel, models in plan.configs.items() for m, c in models.items()}
    sweeps: dict[tuple[str, Model], SweepResult] = {}
    for sharing in _sharing(problems):
        every = [p for key in sharing for p in problems[key]]
        began = time.perf_counter()
        found = run_sweep(every, plan.sweep, plan.seed, workers, keep.sweep(*sharing[0]) if keep else None)
        first = 0
        for key in sharing:
            sweeps[key] = found.part(slice(first, first + len(problems[key])))
            first += len(problems[key])
        told = " and ".join(f"{gel} {model}" for gel, model in sharing)
        spent = time.perf_counter() - began
        say(f"{told}: sweep of {found.trajectories} trajectories against {len(every)} data sets in {spent:.1f} s")
    seconds["sweep"] = time.perf_counter() - start
    start = time.perf_counter()
    fits: dict[str, dict[Model, Fit]] = {gel: {} for gel in plan.configs}
    for (gel, model), sets in problems.items():
        config, began = plan.configs[gel][model], time.perf_counter()
        with make_executor(config.model, workers) as executor:
            analyses = tuple(assimilate(p, config.assimilation, config.seed, executor) for p in sets)
        say(f"{gel} {model}: En4D-Var of {len(sets)} data sets in {time.perf_counter() - began:.1f} s")
        fits[gel][model] = Fit(gel, model, sets, sweeps[gel, model], analyses)
    again = {gel: _narrow(models.get("qlkv"), plan, workers) for gel, models in fits.items()}
    narrow = {gel: fit for gel, fit in again.items() if fit is not None}
    seconds["en4dvar"] = time.perf_counter() - start
    start = time.perf_counter()
    populations, comparisons = {}, {}
    for gel, models in fits.items():
        for m, fit in models.items():
            models[m] = replace(fit, evidence=_evidence(fit, plan, workers, keep))
        kept = {m: fit for m, fit in models.items() if m in ("nh", "qlkv")}
        found_for: dict[Model, Population | None]
        found_for = {m: _population(fit, plan, workers, keep) for m, fit in kept.items()}
        if (general := found_for.get("qlkv")) is not None:
            populations[gel] = general
        if len(kept) == 2:
            comparisons[gel] = _compare(models, found_for, workers, keep)
    seconds["population"] = time.perf_counter() - start
    say(f"population and model comparison in {seconds['population']:.1f} s")
    truth = read_truth(plan.truth) if plan.truth else {}
    return Study(plan, fits, populations, comparisons, truth, seconds, narrow)


def _narrow(fit: Fit | None, plan: StudyPlan, workers: int) -> Fit | None:
    """None where the paper prints no spread of R0, or R0 is not estimated."""
    printed = TABLE_2.get(fit.gel, {}).get(fit.model, {}).get("R0") if fit else None
    if fit is None or printed is None or not fit.estimated("R0"):
        return None
    relative = printed[1] / printed[0]
    terms = tuple(replace(t, std=relative) if t.parameter.name == "R0" else t for t in fit.prior.terms)
    problems = tuple(replace(p, prior=Prior(terms)) for p in fit.problems)
    config = plan.configs[fit.gel][fit.model]
    with make_executor(config.model, workers) as executor:
        analyses = tuple(assimilate(p, config.assimilation, config.seed, executor) for p in problems)
    return replace(fit, problems=problems, analyses=analyses)


def _start(fit: Fit) -> Array:
    """(S, N, n) posterior members in transformed space; one that failed is replaced by the centre."""
    members = [np.where(np.isfinite(a.posterior), a.posterior, a.centre) for a in fit.analyses]
    return np.stack([fit.prior.from_physical(m) for m in members])


def _sharing(problems: Mapping[tuple[str, Model], Sequence[InverseProblem]]) -> list[list[tuple[str, Model]]]:
    """Gel and model of the data sets that one design serves: those of one model with the same values fixed."""
    groups: dict[object, list[tuple[str, Model]]] = {}
    for (gel, model), sets in problems.items():
        groups.setdefault((model, tuple(sorted(sets[0].fixed.items()))), []).append((gel, model))
    return list(groups.values())


def _evidence(fit: Fit, plan: StudyPlan, workers: int, keep: Keep | None) -> Evidence:
    compute = partial(set_evidence, SetRuns(fit.problems, workers), fit.prior, plan.seed)
    return keep.of(Evidence, compute, fit.gel, fit.model) if keep else compute()


def _population(fit: Fit, plan: StudyPlan, workers: int, keep: Keep | None) -> Population | None:
    """None with fewer than 3 data sets."""
    if len(fit.problems) < 3:
        return None
    names = [name for name in POPULATION if fit.estimated(name)]
    compute = partial(_estimated, fit, plan, workers, names)
    return keep.of(Population, compute, fit.gel, fit.model) if keep else compute()


def _estimated(fit: Fit, plan: StudyPlan, workers: int, names: Sequence[str]) -> Population:
    runs = SetRuns(fit.problems, workers)
    return estimate_population(runs, _start(fit), fit.prior, names, plan.seed, effort=plan.population, workers=workers)


def _compare(
    models: Mapping[Model, Fit], populations: Mapping[Model, Population | None], workers: int, keep: Keep | None
) -> Comparison:
    single = {m: models[m].log_evidence for m in populations}
    pooled = {m: np.nan if found is None else found.log_evidence for m, found in populations.items()}
    gels = {}
    for m in populations:
        compute = partial(_one_gel, models[m], workers)
        gels[m] = keep.of(OneGel, compute, models[m].gel, m) if keep else compute()
    return compare_laws(single["qlkv"] - single["nh"], pooled["qlkv"] - pooled["nh"], gels["nh"], gels["qlkv"])


def _one_gel(fit: Fit, workers: int) -> OneGel:
    names = [name for name in SHARED if fit.estimated(name)]
    members = _start(fit)
    centres = members.mean(axis=1)
    starts = np.stack([centres, (centres + fit.prior.mean) / 2])
    return fit_one_gel(SetRuns(fit.problems, workers), starts, fit.prior, names)


def read_truth(path: Path) -> dict[str, dict[str, float]]:
    """Data set → parameter → SI value, of a ``truth.csv`` of a synthetic campaign. Raises :class:`DataError`."""
    try:
        lines = [line for line in path.read_text(encoding="utf-8").splitlines() if not line.startswith("#")]
        rows = list(csv.DictReader(lines))
        return {
            row["dataset"]: {name: factor * float(row[column]) for column, (name, factor) in _TRUTH_UNITS.items()}
            for row in rows
        }
    except (OSError, KeyError, ValueError) as error:
        raise DataError(f"{path}: not the truth of a synthetic campaign of bubbles: {error!r}") from None


def per_set_csv(study: Study) -> str:
    """One line a gel, model, data set and parameter, in the units of the tables: both routes, truth, fit, DFS."""
    head = "gel,model,dataset,parameter,unit,sweep,en4dvar_mean,en4dvar_std,q05,q50,q95,dfs,truth"
    lines = [f"{head},nrmse_sweep,nrmse_en4dvar,log_evidence"]
    for gel, models in study.fits.items():
        for model, fit in models.items():
            scores = {route: fit.nrmse(route) for route in ("sweep", "en4dvar")}
            for q in QUANTITIES:
                if not fit.estimated(q.name):
                    continue
                j, best = fit.prior.names.index(q.name), fit.values("sweep", q.name)
                for i, (a, evidence) in enumerate(zip(fit.analyses, fit.log_evidence, strict=True)):
                    x = q.factor * a.posterior[:, j]
                    true = study.truth.get(a.name, {}).get(q.name, np.nan) * q.factor
                    numbers = [best[i] * q.factor, np.nanmean(x), np.nanstd(x, ddof=1)]
                    numbers += [*np.nanquantile(x, (0.05, 0.5, 0.95)), a.dfs_per_parameter[j], true]
                    numbers += [scores["sweep"][i], scores["en4dvar"][i], evidence]
                    values = ",".join(f"{v:.6g}" for v in numbers)
                    lines.append(f"{gel},{model},{a.name},{q.name},{q.unit},{values}")
    return "\n".join(lines) + "\n"
