"""The reports of an assimilation on its way, and its outcome for one data set."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from en4dvar.data.observations import Observations
from en4dvar.diagnosis.influence import Influence
from en4dvar.diagnosis.residuals import Residuals
from en4dvar.diagnosis.response.ledger import Ledger
from en4dvar.diagnosis.response.what_if import Shift
from en4dvar.diagnosis.withheld import Withheld
from en4dvar.model.state import Array, Parameter
from en4dvar.plumbing.caution import Caution
from en4dvar.plumbing.hints import counted
from en4dvar.plumbing.units import convert, unit_after
from en4dvar.priors.field_prior import FieldPrior
from en4dvar.priors.varying import RandomWalk
from en4dvar.problem import InverseProblem
from en4dvar.schemes.settings import AssimilationSettings


@dataclass(frozen=True)
class IterationRecord:
    """Diagnostics of one iteration (glossary of the field). Parameters are physical, SI.

    ``cost = background + observation`` is J of the central trajectory at the iterate that *starts* the iteration;
    the last record is the accepted end point. ``step_norm`` is the undamped step there in posterior standard
    deviations, ``step_length`` the accepted fraction of it (0: no move). ``members`` (N, n) is the ensemble that the
    scheme's weights and transform describe at that iterate. ``active`` counts the members whose forecast
    succeeded; it is N where fewer runs gave the tangent and none failed.
    """

    iteration: int
    cost: float
    background: float
    observation: float
    step_norm: float
    step_length: float
    chi2_per_observation: float
    dfs: float
    spread: float
    active: int
    members: Array
    centre: Array


@dataclass(frozen=True)
class ChainRecord:
    """Where a Markov chain (``refine: mcmc``) stands: steps, largest split R-hat, smallest effective sample size."""

    steps: int
    r_hat: float
    effective: float


@dataclass(frozen=True)
class StartRecord:
    """Where the descents stand that decide where the iterations start: rounds of moves, J of each descent, and how
    many are under way. The moves of the lowest become the first iterations. ``further``: the number of the round of
    descents after these, that look for another minimum, from 1.
    """

    rounds: int
    costs: tuple[float, ...]
    active: int
    further: int = 0


@dataclass(frozen=True)
class Descents:
    """Where all descents of one data set ended.

    ``members`` (D,) of the prior ensemble from which they started, -1 for its mean, -2 for a draw beyond the ensemble;
    ``minimum`` (D,) the number of the minimum of J in which each ended, 0 is the lowest and -1 none, since the model
    failed; ``costs`` of the minima; ``spread``, by how much J of those in the lowest differs; forward ``runs`` of the
    search after the first descents.
    """

    members: tuple[int, ...]
    minimum: tuple[int, ...]
    costs: tuple[float, ...]
    spread: float
    runs: int

    @property
    def agreeing(self) -> int:
        """How many ended in the lowest minimum."""
        return sum(number == 0 for number in self.minimum)

    @property
    def words(self) -> str:
        """In one sentence."""
        of = {n: [i for i, m in zip(self.members, self.minimum, strict=True) if m == n] for n in set(self.minimum)}
        parts = [f"J {self.costs[0]:.6g} from {_members(of.get(0, []))}"]
        if len(of.get(0, [])) > 1:
            parts[0] += f" (within {self.spread:.2g})"
        parts += [f"{self.costs[n]:.6g} from {_members(of[n])}" for n in sorted(of) if n > 0]
        if -1 in of:
            parts.append(f"no minimum from {_members(of[-1])}")
        return f"{counted(len(self.members), 'descent')} ended at {', '.join(parts)}"


def _members(numbers: Sequence[int]) -> str:
    known = [str(i) for i in numbers if i >= 0]
    listed = " and ".join(part for part in (", ".join(known[:-1]), *known[-1:]) if part)
    names = [f"member{'s' * (len(known) > 1)} {listed}"] if known else []
    mean = ["the prior mean"] if -1 in numbers else []
    draws = sum(i == -2 for i in numbers)
    beyond = [f"{draws} draws" if draws > 1 else "a draw"] if draws else []
    return " and ".join([*names, *mean, *beyond])


Record = IterationRecord | StartRecord | Descents | ChainRecord
Progress = Callable[[str, Record], None]  # what hears of them, with the name of the data set


@dataclass(frozen=True)
class Discrepancy:
    """The part of the observations that the model misses, given the residual at the centre: ``mean`` and ``std`` (K,)
    in the observable's unit.

    ``shares`` (n, 3) divide the posterior variance of each parameter, transformed and in the linear approximation at
    the centre, into what comes from the readings' errors, from the discrepancy, and from the prior; rows sum to 1.
    """

    mean: Array
    std: Array
    shares: Array


BEYOND_5 = 1.6449  # standard deviations beyond which 5 % of a Gaussian lie


@dataclass(frozen=True)
class Mode:
    """A minimum of J with some of the probability: J there, how many descents from different members ended in it, by
    how much J of these differs, and its weight in the posterior.

    ``centre``, ``q05`` and ``q95`` (n,) are the median of the draws that belong to it, and 5 and 95 % of them, where
    the posterior was sampled; else the minimum, and those of the Gaussian about it. Physical, SI.
    """

    centre: Array
    q05: Array
    q95: Array
    cost: float
    descents: int
    spread: float
    weight: float


@dataclass(frozen=True)
class FieldEstimate:
    """Prior and posterior of a field of the initial state: values of its cells, in its unit. ``members`` (N, size) of
    the posterior; ``centre``, ``mean`` and ``std`` (size,) of it, and of the prior.
    """

    prior: FieldPrior
    members: Array
    centre: Array
    mean: Array
    std: Array
    prior_mean: Array
    prior_std: Array


@dataclass(frozen=True)
class Analysis:
    """The outcome for one data set: members in order, physical SI values, NaN where a member failed. Shapes: N members,
    n estimated parameters, K observations, M points of the plotting grid.
    """

    problem: InverseProblem
    settings: AssimilationSettings
    seed: int
    fixed_parameters: tuple[Parameter, ...]  # what ``problem.fixed`` holds values of
    prior: Array  # (N, n)
    posterior: Array  # (N, n)
    centre: Array  # (n,) the minimum of J
    prior_predictions: Array  # (N, K) noise-free H(F(x))
    posterior_predictions: Array  # (N, K)
    centre_predictions: Array  # (K,)
    error_std: Array  # (K,) total observation-error std at the centre, timing error included
    own_std: Array  # (K,) the same without what a discrepancy adds
    log_likelihood: Array  # (N, K) of the posterior members
    trajectory_times: Array  # (M,) on the clock of the observations (member i is seen at t + t_s,i)
    prior_trajectories: Array  # (N, M) observable along the path
    posterior_trajectories: Array  # (N, M)
    prior_failures: tuple[str, ...]  # (N,) reason, "" where the member is alive
    posterior_failures: tuple[str, ...]  # (N,)
    iterations: tuple[IterationRecord, ...]
    dfs_per_parameter: Array  # (n,) 1 - posterior variance / prior variance, in transformed space
    converged: bool
    stop_reason: str
    forward_runs: int
    cautions: tuple[Caution, ...] = ()  # why not to trust the posterior, the worst first
    log_evidence: float = float("nan")  # ln p(y), Laplace approximation
    log_evidence_constant: float | None = None  # the same with constant parameters, NaN if unknown; None if none varies
    shape: Mapping[str, float] = field(default_factory=dict)  # how Gaussian the posterior is (en4dvar.sampling.refine)
    down_weights: Array | None = None  # (K,) of observations in a robust cost, at the centre; None with Gaussian errors
    refinement: Mapping[str, float] = field(default_factory=dict)  # summary of the Markov chain, if any
    residuals: Residuals | None = None  # whitened, at the centre, with what is expected of them
    chi2: float | None = None  # per observation, with an estimated noise scale as the residuals; None without
    discrepancy: Discrepancy | None = None  # of the model, at the centre; None where none is allowed for
    timing: float = 0.0  # std of the times that explains the residuals better than what is stated does; 0: none does
    extremes: Array = field(default_factory=lambda: np.empty((0, 0)))  # (N, V) of the model's limits, by the posterior
    beyond: Array = field(default_factory=lambda: np.empty((0, 0)))  # (N, V) since when it exceeds them; +inf: never
    what_if: tuple[Shift, ...] = ()  # under the model's alternatives; the largest first
    influence: Influence | None = None  # of each reading; None where it cannot be told
    modes: tuple[Mode, ...] = ()  # minima of J that count, the lowest first; () of a scheme that does not search
    descents: Descents | None = None  # where all of them ended; None of a scheme that does not search
    withheld: Withheld | None = None  # the readings after the window, and what was expected of them
    ledger: Ledger | None = None  # what the path went through where it informed the parameters
    fields: tuple[FieldEstimate, ...] = ()  # of the initial state
    draws: Array = field(default_factory=lambda: np.empty((0, 0)))  # (D, n) of a posterior that was sampled, beside

    def __repr__(self) -> str:
        told = []
        for p, values in zip(self.parameters, self.posterior.T, strict=True):
            mean, std = (convert(float(f(values)), p.unit, p.display_unit) for f in (np.nanmean, np.nanstd))
            told.append(f"{p.name} {mean:.4g} ± {std:.2g}{unit_after(p.display_unit)}")
        ended = "converged" if self.converged else "not converged"
        return f"<Analysis {self.name}: {', '.join(told)}; {ended}, warnings: {len(self.cautions)}>"

    @property
    def survivors(self) -> Array:
        """(N', n) the posterior members that are alive."""
        return self.posterior[[not reason for reason in self.posterior_failures]]

    @property
    def observations(self) -> Observations:
        """The observations that were assimilated."""
        return self.problem.observations

    @property
    def name(self) -> str:
        """Name of the data set."""
        return self.observations.name

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """The estimated parameters, (n,)."""
        return self.problem.prior.parameters

    @property
    def fit(self) -> tuple[float, float]:
        """χ² per observation and DFS, where the noise scale is estimated with that of the posterior."""
        last, residuals = self.iterations[-1], self.residuals
        if self.chi2 is None or residuals is None:
            return last.chi2_per_observation, last.dfs
        return self.chi2, residuals.dfs

    @property
    def log_evidence_change(self) -> float | None:
        """ln of the Bayes factor of parameters that vary against constant ones; None where none varies."""
        return None if self.log_evidence_constant is None else self.log_evidence - self.log_evidence_constant

    def pieces(self, walk: RandomWalk, members: Array) -> Array:
        """Values (N, m + 1) over the pieces of a parameter that varies, of ``members`` (N, n)."""
        return walk.pieces({name: members[:, j] for j, name in enumerate(self.problem.prior.names)})

    @property
    def warnings(self) -> tuple[str, ...]:
        """The words of the cautions."""
        return tuple(c.words for c in self.cautions)
