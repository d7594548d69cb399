"""Synthetic experiments: what makes their readings, where not what they are fitted with, and what is estimated."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from records import Record
from scipy.stats import binomtest

from en4dvar.diagnosis.ranks import uniform_ranks
from en4dvar.ensemble.forecast import Forecast, forecast
from en4dvar.estimation.assimilate import assimilate
from en4dvar.model.state import Array, Parameter
from en4dvar.plumbing.errors import En4dvarError
from en4dvar.priors.prior import Prior
from en4dvar.problem import InverseProblem
from en4dvar.schemes.settings import AssimilationSettings
from en4dvar_bubble import BubbleModel

CENTRAL = (25, 45)  # of 49 ranks: the central intervals nearest to 50 and 90 %
LEVEL = 0.01  # of every test
FAR_OFF = 8.0  # standard deviations of an outlier


@dataclass(frozen=True)
class Twin:
    """An inverse problem and the truth (n,), transformed, that made its data."""

    problem: InverseProblem
    truth: Array


@dataclass(frozen=True)
class World:
    """By default everything is as the fit has it; ``stream`` keeps its random numbers apart from an experiment's.

    ``renamed``: parameter of the fit → that of ``model`` which has its value. ``fixed`` values of ``model``, SI.
    Readings are ``scale`` times what they should be, each is made up to ``jitter`` (s) before or after its instant,
    errors forget themselves in ``correlation_time`` (s), and a share of them, ``outliers``, is 8 standard deviations.
    """

    model: BubbleModel | None = None
    renamed: Mapping[str, Parameter] = field(default_factory=dict)
    fixed: Mapping[str, float] = field(default_factory=dict)
    scale: float = 1.0
    jitter: float = 0.0
    correlation_time: float = 0.0
    outliers: float = 0.0
    stream: int = 20212

    def run(self, problem: InverseProblem, truth: Array, seed: int) -> Forecast:
        """The experiment of a truth (n,), the values of the parameters of the fit, transformed."""
        model, observed = self.model or problem.model, problem.observations
        terms = (replace(t, parameter=self.renamed.get(t.parameter.name, t.parameter)) for t in problem.prior.terms)
        off = np.random.default_rng([self.stream, seed, 0]).uniform(-self.jitter, self.jitter, len(observed.times))
        made = InverseProblem(
            model,
            model.observables[0],
            replace(observed, times=observed.times + off),
            Prior(tuple(terms)),
            {**problem.fixed, **self.fixed},
        )
        return forecast(made, truth[None])

    def values(self, problem: InverseProblem, run: Forecast, normal: Array, seed: int) -> Array:
        """Readings (K,) of its run; ``normal`` (K,) are standard normal."""
        observed = problem.observations
        errors = normal
        if self.correlation_time:
            lags = np.abs(np.subtract.outer(observed.times, observed.times))
            errors = np.linalg.cholesky(np.exp(-lags / self.correlation_time)) @ errors
        random = np.random.default_rng([self.stream, seed, 1])
        far = random.random(len(normal)) < self.outliers
        errors = np.where(far, FAR_OFF * random.choice((-1.0, 1.0), len(normal)), errors)
        return np.asarray(self.scale * run.predictions[0] + observed.noise.std * errors)


RIGHT = World()


def read_once(problem: InverseProblem, seed: list[int], world: World = RIGHT) -> Twin:
    """Readings at the times of a problem, of a truth from its prior."""
    of, observed, rng = problem.prior, problem.observations, np.random.default_rng(seed)
    while True:
        truth = of.mean + of.std * rng.standard_normal(len(of.names))
        run = world.run(problem, truth, seed[-1])
        if not run.failures[0]:
            break
    values = world.values(problem, run, rng.standard_normal(len(observed.times)), seed[-1])
    return Twin(replace(problem, observations=replace(observed, values=values)), truth)


def experiment(seed: int, twin: Twin, settings: AssimilationSettings) -> Record:
    """Ranks, moments (n,) of the posterior ensemble in transformed space, and the truth."""
    of = twin.problem.prior
    try:
        analysis = assimilate(twin.problem, settings, seed)
    except En4dvarError as error:  # counted: no run may fail
        return {"failure": str(error)}
    x = of.from_physical(analysis.survivors)[:, : len(twin.truth)]  # amplitude and length of a discrepancy are last
    return {
        "truth": twin.truth,
        "mean": x.mean(axis=0),
        "std": x.std(axis=0, ddof=1),
        "rank": np.sum(x < twin.truth, axis=0),
        "converged": analysis.converged,
        "warned": [c.code for c in analysis.cautions],
        "graver": [c.code for c in analysis.cautions if c.severity != "note"],
        "log_evidence": analysis.log_evidence,
        "runs": analysis.forward_runs,
        "what_if": {shift.name: shift.in_std for shift in analysis.what_if if shift.settled},
        **analysis.refinement,
    }


def verdict(passed: bool) -> str:
    return "ok" if passed else "MISSED"


def table(records: list[Record], names: tuple[str, ...]) -> None:
    """Print ranks, z-scores and coverage of every parameter."""
    good = [record for record in records if "failure" not in record]
    print(f"{len(records)} experiments, failed runs: {len(records) - len(good)} {verdict(len(good) == len(records))}")
    for record in records:
        if "failure" in record:
            print(f"  experiment {record['key']}: {record['failure']}")
    truth, mean, std, rank = (np.array([r[key] for r in good]) for key in ("truth", "mean", "std", "rank"))
    z, members = (truth - mean) / std, 48
    # between two members lies a whole number of the 49 ranks: 25 of them make 51.0 %, 45 of them 91.8 %
    within = {ranks / (members + 1): 2 * np.abs(rank - members / 2) < ranks for ranks in CENTRAL}
    heads = " | ".join(f"inside {share:.1%}" for share in within)
    print(f"| parameter | p of uniform ranks | std of z | mean of z | {heads} | |")
    print("|---|---|---|---|---|---|---|")
    for j, name in enumerate(names):
        p = uniform_ranks(len(good), members).p_value(rank[:, j])
        spread = z[:, j].std(ddof=1)
        inside = [int(np.sum(each[:, j])) for each in within.values()]
        passed = p > LEVEL and 0.9 <= spread <= 1.1
        passed &= all(binomtest(i, len(z), share).pvalue > LEVEL for i, share in zip(inside, within, strict=True))
        cells = [f"{p:.3f}", f"{spread:.3f}", f"{z[:, j].mean():+.3f}", *(f"{i / len(z):.1%}" for i in inside)]
        print(f"| {name} | {' | '.join(cells)} | {verdict(passed)} |")
