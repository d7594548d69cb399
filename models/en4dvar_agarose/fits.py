"""The fits of the study for each gel and model, their summaries, and which law they favour, or when not to decide."""

import csv
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from en4dvar.diagnosis.analysis import Analysis
from en4dvar.diagnosis.diagnostics import nrmse
from en4dvar.estimation.population import HyperPrior, Population
from en4dvar.estimation.population.own import OwnDraws
from en4dvar.model.state import Array
from en4dvar.plumbing.errors import DataError
from en4dvar.plumbing.files import read_text
from en4dvar.priors.prior import Prior
from en4dvar.problem import InverseProblem
from en4dvar.sampling.sweep import SweepResult, by_fit
from en4dvar_agarose.paper import Model, Route
from en4dvar_agarose.settings import StudyPlan

_TRUTH_UNITS = {"G_kPa": ("G", 1e3), "alpha": ("alpha", 1.0), "mu_Pa_s": ("mu", 1.0), "R0_um": ("R0", 1e-6)}
DECISIVE = 3.0  # |Δ log-evidence|: odds of 20 to 1
HYPER = HyperPrior(spread=1.0)  # R0 of the softer gel varies by more than what is known of it beforehand
LEVELS = (0.025, 0.5, 0.975)  # of the interval of a population, and its middle
MISFIT = 2.0  # χ² per reading above which a model is not one of those to choose from
UNSURE = ("not-converged", "non-gaussian", "starts-disagree")  # cautions by which an evidence may be off


@dataclass(frozen=True)
class Fit:
    """Both routes of one model on the S data sets of one gel."""

    gel: str
    model: Model
    problems: tuple[InverseProblem, ...]
    sweep: SweepResult
    analyses: tuple[Analysis, ...]
    sampled: tuple[OwnDraws, ...] = ()

    @property
    def log_evidence(self) -> Array:
        """(S,) ln p(y); by Laplace's approximation where it was not sampled."""
        if not self.sampled:
            return self.laplace_evidence
        each = zip(self.sampled, self.problems, strict=True)
        return np.array([draws.log_evidence - p.observations.log_normalisation() for draws, p in each])

    @property
    def laplace_evidence(self) -> Array:
        """(S,) ln p(y) by Laplace's approximation at the end of the iterations."""
        return np.array([a.log_evidence for a in self.analyses])

    @property
    def prior(self) -> Prior:
        return self.problems[0].prior

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(p.observations.name for p in self.problems)

    @property
    def starts(self) -> Array:
        """(S, N, n) posterior members in white coordinates; one that failed is replaced by the centre."""
        members = [np.where(np.isfinite(a.posterior), a.posterior, a.centre) for a in self.analyses]
        return np.stack([self.prior.white(self.prior.from_physical(m)) for m in members])

    def values(self, route: Route, name: str) -> Array:
        """(S,) estimates of a parameter, SI: best fits of the sweep, or means of the posterior ensembles."""
        if name in self.problems[0].fixed:
            return np.full(len(self.problems), self.problems[0].fixed[name])
        if route == "sweep":
            return np.asarray(self.sweep.theta[:, [p.name for p in self.sweep.parameters].index(name)])
        return np.array([np.nanmean(a.posterior[:, self.prior.names.index(name)]) for a in self.analyses])

    def estimated(self, name: str) -> bool:
        return name in self.prior.names

    def nrmse(self, route: Route) -> Array:
        """(S,) NRMSE of the best fit, or of the centre of the posterior."""
        if route == "sweep":
            return self.sweep.nrmse
        each = ((a.observations, a.centre_predictions) for a in self.analyses)
        return np.array([nrmse(o.values[o.used], predicted[o.used]) for o, predicted in each])

    def summary(self, route: Route, name: str) -> tuple[float, float]:
        """NRMSE-weighted mean and standard deviation over the sets, SI; a fixed value has none."""
        if not self.estimated(name):
            return self.problems[0].fixed[name], 0.0
        mean, std = by_fit(self.values(route, name), self.nrmse(route))
        return float(mean), float(std)

    def dfs(self) -> dict[str, float]:
        """Degrees of freedom for signal of each estimated parameter, mean over the sets."""
        mean = np.mean([a.dfs_per_parameter for a in self.analyses], axis=0)
        return dict(zip(self.prior.names, mean, strict=True))

    def members(self, name: str) -> Array:
        """(S·N,) posterior members of all sets, SI; failed ones left out."""
        j = self.prior.names.index(name)
        stacked = np.concatenate([a.posterior[:, j] for a in self.analyses])
        return np.asarray(stacked[np.isfinite(stacked)])

    def prior_members(self, name: str) -> Array:
        """(S·N,) members of the priors of all sets, SI."""
        j = self.prior.names.index(name)
        return np.concatenate([a.prior[:, j] for a in self.analyses])


@dataclass(frozen=True)
class Study:
    """All that the report shows. ``truth``: data set → parameter → SI value, empty without a twin. ``narrow``: the
    general quadratic law again, with a prior on R0 as narrow as the spread that Table 2 prints.
    """

    plan: StudyPlan
    fits: Mapping[str, Mapping[Model, Fit]]
    populations: Mapping[str, Population]
    comparisons: "Mapping[str, Comparison]"
    truth: Mapping[str, Mapping[str, float]]
    seconds: Mapping[str, float] = field(default_factory=dict)
    narrow: Mapping[str, Fit] = field(default_factory=dict)

    @property
    def every_fit(self) -> tuple[Fit, ...]:
        return tuple(fit for models in self.fits.values() for fit in models.values())

    def any_fit(self, gel: str) -> Fit:
        """The fit of some model; all have the same data sets."""
        return next(iter(self.fits[gel].values()))

    def true_values(self, gel: str, name: str) -> Array:
        """(S,) true values of a gel's data sets, SI; empty where there is no truth."""
        return np.array([self.truth[n][name] for n in self.any_fit(gel).names if n in self.truth])

    def coverage(self, gel: str, model: Model, name: str) -> float:
        """Share of the data sets whose central 90 % posterior interval holds the truth; NaN without a truth."""
        fit = self.fits[gel][model]
        j = fit.prior.names.index(name)
        inside = [
            low <= self.truth[a.name][name] <= high
            for a in fit.analyses
            if a.name in self.truth
            for low, high in [np.nanquantile(a.posterior[:, j], (0.05, 0.95))]
        ]
        return float(np.mean(inside)) if inside else float("nan")


def read_truth(path: Path) -> dict[str, dict[str, float]]:
    """Data set → parameter → SI value, of a ``truth.csv`` of a synthetic campaign. Raises :class:`DataError`."""
    try:
        lines = [line for line in read_text(path).splitlines() if not line.startswith("#")]
        return {
            row["dataset"]: {name: factor * float(row[column]) for column, (name, factor) in _TRUTH_UNITS.items()}
            for row in csv.DictReader(lines)
        }
    except (OSError, KeyError, ValueError) as error:
        raise DataError(f"{path}: not the truth of a synthetic campaign of bubbles: {error!r}") from None


@dataclass(frozen=True)
class Comparison:
    """Log-evidence of the quadratic over the neo-Hookean law.

    ``single`` (S,) of each data set by itself. ``population``: parameters of all bubbles about a common mean with a
    common spread. ``shared``: of all of them in one gel, material parameters common and R0, t_s of each bubble's own.
    ``chi2`` of one gel per reading, (neo-Hookean, quadratic): far from one where no single gel explains the readings.
    ``doubts``: codes of cautions for which ``shared`` may be off.
    """

    single: Array
    population: float
    shared: float
    chi2: tuple[float, float]
    doubts: tuple[str, ...]

    @property
    def independent(self) -> float:
        """Evidence of all data sets, every bubble in a gel of its own."""
        return float(self.single.sum())

    @property
    def undecidable(self) -> int:
        """Data sets that cannot tell the laws apart."""
        return int(np.sum(np.abs(self.single) < DECISIVE))


@dataclass(frozen=True)
class OneByOne:
    """Draws of the posterior of each data set."""

    sampled: tuple[OwnDraws, ...]


@dataclass(frozen=True)
class OneGel:
    """One law with one value of its parameters in all data sets of a gel, and codes of doubts about its evidence."""

    log_evidence: float
    chi2_per_observation: float
    doubts: tuple[str, ...] = ()


def probability(difference: Array) -> Array:
    """Probability of the favoured-by-positive model at equal prior odds, 1/(1 + e^−Δ)."""
    return np.asarray(0.5 * (1 + np.tanh(np.asarray(difference) / 2)))


def verdict(difference: float) -> str:
    """In words: which model, and at what odds, or that the data cannot tell."""
    if not math.isfinite(difference):
        return "unknown"
    if abs(difference) < DECISIVE:
        return "undecidable"
    return f"{'quadratic law' if difference > 0 else 'neo-Hookean'} (odds e^{abs(difference):.0f} : 1)"
