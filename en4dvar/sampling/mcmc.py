"""Refinement by Markov chain Monte Carlo: the posterior ensemble as the first positions of an ensemble sampler.

Walkers move by differential evolution (ter Braak 2006, Stat. Comput. 16, 239) and stretches (Goodman & Weare 2010,
Commun. Appl. Math. Comput. Sci. 5, 65), half of them at a time, so that a step is two calls of the forward model. The
chain is lengthened until it has mixed (split R-hat, effective sample size: Gelman et al. 2013, Bayesian Data Analysis,
§ 11.4-11.5) and thinned to the size of the ensemble.

With an emulator of the density most steps are guided: a walker makes many moves on the emulator, which costs no run of
the model, and the end point is accepted on the density itself, so that the chain samples it exactly whatever the
emulator is worth (surrogate transition method: Liu 2001, Monte Carlo Strategies in Scientific Computing, § 9.4.3).

Where the posterior has several modes, walkers start in all of them and half of the steps are jumps to independent draws
of a mixture that covers them (Tierney 1994, Ann. Stat. 22, 1701). R-hat compares walkers of different modes, so that it
is near 1 only where jumps were accepted often enough to tell the weights.

emcee's snooker move is not used: with 48 walkers in 5 dimensions it gave standard deviations 30 % too small.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from en4dvar.diagnosis.analysis import ChainRecord
from en4dvar.diagnosis.diagnostics import off
from en4dvar.model.state import Array
from en4dvar.plumbing.errors import En4dvarError
from en4dvar.sampling.alike import LEAST, POOL, standing_for
from en4dvar.sampling.emulated_cost import EmulatedCost
from en4dvar.sampling.mixture import StudentMixture
from en4dvar.sampling.walkers import advance

DE_SHARE = 0.8  # of the moves, the rest are stretches
JUMPS = 0.5  # share of the steps where there is a mixture to draw from
GUIDED_SHARE, GUIDED_MOVES = 0.85, 60  # of the steps where there is an emulator; its moves in one of them
BURN_IN = 0.25  # of the chain, dropped at its start
MAX_R_HAT = 1.1  # Gelman et al. (2013), § 11.5
ENOUGH = 1000.0  # effective sample size
BLOCK = 50  # steps between two looks at convergence
SCATTER = 0.1  # walkers are spread by this much more than the ensemble, so that no two coincide
ASTRAY = 10.0  # by which J exceeds the emulator's where a walker must not start: an empty basin would trap it


@dataclass(frozen=True)
class Chain:
    """The sampler's output: ``samples`` (steps, walkers, n) after burn-in and the numbers that judge it.

    ``r_hat`` and ``effective`` (n,) are split R-hat and effective sample size; ``off`` is how far the ensemble that it
    started from is from it (:func:`~en4dvar.diagnosis.diagnostics.off`).
    """

    samples: Array
    log_density: Array
    r_hat: Array
    effective: Array
    acceptance: float
    steps: int
    converged: bool
    off: tuple[float, float]

    @property
    def flat(self) -> Array:
        return np.asarray(self.samples.reshape(-1, self.samples.shape[-1]))

    def thin(self, n_members: int, exact: bool = False) -> Array:
        """(N, n) draws, evenly spaced over the chain, walkers in turn.

        ``exact``: nearly of the moments and quantiles of the whole chain, see :mod:`~en4dvar.sampling.alike`.
        """
        steps, walkers, _ = self.samples.shape
        count = max(POOL * n_members, LEAST) if exact else n_members
        index = np.arange(count)
        draws = np.asarray(self.samples[steps - 1 - (index * steps) // count, index % walkers])
        if not exact:
            return draws
        every = np.arange(n_members) * count // n_members
        return standing_for(draws, every, self.flat.mean(axis=0), np.cov(self.flat.T))

    def warning(self) -> str:
        return (
            f"the Markov chain has not converged after {self.steps} steps (R-hat {np.max(self.r_hat):.3f}, effective "
            f"sample size {np.min(self.effective):.0f}): its ensemble is not yet the posterior"
        )

    def summary(self) -> dict[str, float]:
        """The numbers that judge the chain, for the result file."""
        return {
            "mcmc_steps": self.steps,
            "mcmc_walkers": self.samples.shape[1],
            "mcmc_acceptance": self.acceptance,
            "mcmc_r_hat": float(np.max(self.r_hat)),
            "mcmc_effective_sample_size": float(np.min(self.effective)),
            "mcmc_converged": self.converged,
            "mcmc_largest_shift": self.off[0],
            "mcmc_largest_spread_ratio": max(self.off[1], 1 / self.off[1]),
        }


def sample(
    log_density: Callable[[Array], Array],
    ensemble: Array,
    seed: int,
    *,
    walkers: int = 48,
    max_steps: int = 4000,
    target: float | None = None,
    look: Callable[[ChainRecord], None] | None = None,
    emulated: EmulatedCost | None = None,
    proposal: StudentMixture | None = None,
) -> Chain:
    """Sample a density from the neighbourhood of an ensemble.

    ``log_density``: of positions (B, n) → (B,), −inf where it vanishes; called with half of the walkers at a time.
    ``ensemble``: (N, n) the Gaussian approximation; walkers start from its members, slightly scattered. ``seed``: of
    the walkers; the same seed gives the same bits. ``walkers``: at least 2 (n + 1), even. ``max_steps``: at most.
    ``target``: effective sample size to reach in each direction (default: :data:`ENOUGH`). ``look``: called with what
    each look at convergence shows. ``emulated``: an approximation at no cost; it guides the walkers, which start from
    draws of it. ``proposal``: covers all modes; walkers jump to draws of it.

    Raises En4dvarError: the density vanishes at (nearly) every member.
    """
    import emcee  # a twentieth of a second that most runs do not need

    n, target = ensemble.shape[1], ENOUGH if target is None else target
    walkers = max(walkers, 2 * (n + 1)) + max(walkers, 2 * (n + 1)) % 2
    state = _start(log_density, ensemble, seed, walkers, emulated)
    sampler = emcee.EnsembleSampler(walkers, n, log_density, vectorize=True, moves=_moves(emcee, emulated, proposal))
    sampler.log_prob_fn = log_density  # bare: emcee's wrapper prints every position where Ctrl-C comes
    while True:
        steps = sampler.backend.iteration
        state = sampler.run_mcmc(state, min(max_steps - steps, max(BLOCK, steps // 4)), skip_initial_state_check=True)
        judged = _judged(sampler, target, ensemble)
        if look is not None:
            look(ChainRecord(judged.steps, float(np.max(judged.r_hat)), float(np.min(judged.effective))))
        if judged.converged or judged.steps >= max_steps:
            return judged


def _moves(emcee: Any, emulated: EmulatedCost | None, proposal: StudentMixture | None) -> list[tuple[Any, float]]:
    far = [(emcee.moves.MHMove(_guided(emulated)), GUIDED_SHARE)] if emulated else []
    far += [(emcee.moves.MHMove(_jump(proposal)), JUMPS)] if proposal else []
    near = 1.0 - sum(share for _, share in far)
    return [(emcee.moves.DEMove(), near * DE_SHARE), (emcee.moves.StretchMove(), near * (1 - DE_SHARE)), *far]


def _judged(sampler: Any, target: float, ensemble: Array) -> Chain:
    """The part of a chain after burn-in, and what it says of its convergence."""
    steps = sampler.backend.iteration
    samples = sampler.get_chain()[int(BURN_IN * steps) :]
    r_hat, effective = split_r_hat(samples), effective_sample_size(samples)
    flat = samples.reshape(-1, ensemble.shape[1])
    return Chain(
        samples=samples,
        log_density=sampler.get_log_prob()[-len(samples) :],
        r_hat=r_hat,
        effective=effective,
        acceptance=float(np.mean(sampler.backend.accepted / steps)),
        steps=steps,
        converged=bool(np.all(r_hat < MAX_R_HAT) and np.all(effective >= target)),
        off=off(ensemble, flat.mean(axis=0), flat.std(axis=0)),
    )


def _start(
    log_density: Callable[[Array], Array], ensemble: Array, seed: int, walkers: int, emulated: EmulatedCost | None
) -> Any:
    """The walkers' first positions and the state of the random numbers. Raises :class:`En4dvarError`."""
    import emcee

    n_members, n = ensemble.shape
    random = np.random.Generator(np.random.Philox(key=seed))
    if emulated is None:
        start = ensemble[np.arange(walkers) % n_members]
        start = start + SCATTER * ensemble.std(axis=0) * random.standard_normal(start.shape)
        density = log_density(start)
    else:
        start = emulated.draws[np.linspace(0, len(emulated.draws) - 1, walkers).astype(int)]
        density = log_density(start)
        density = np.where(density + emulated.cost(start) > -ASTRAY, density, -np.inf)
    alive = np.flatnonzero(np.isfinite(density))
    if len(alive) < n + 1:
        raise En4dvarError(f"refine: mcmc: the model cannot run {walkers - len(alive)} of {walkers} walkers")
    for i in np.flatnonzero(~np.isfinite(density)):  # one that cannot be run starts beside one that can
        twin = alive[i % len(alive)]
        start[i] = start[twin] + 1e-3 * (start[twin] - ensemble.mean(axis=0))
    return emcee.State(start, random_state=np.random.RandomState(int(random.integers(2**32))).get_state())


def _guided(emulated: EmulatedCost) -> Callable[[Array, Any], tuple[Array, Array]]:
    """Proposals (W, n), every walker many moves on the emulator away, and the log of what corrects for it (W,)."""

    def propose(x: Array, random: Any) -> tuple[Array, Array]:
        before = emulated.cost(x)
        after, costs = advance(emulated.cost, x, before, emulated.draws, random, GUIDED_MOVES)
        return after, costs - before

    return propose


def _jump(proposal: StudentMixture) -> Callable[[Array, Any], tuple[Array, Array]]:
    """Proposals (W, n) wherever the walkers stand, and the log of what corrects for it (W,)."""

    def propose(x: Array, random: Any) -> tuple[Array, Array]:
        after = proposal.draw(len(x), random)
        return after, proposal.log_density(x) - proposal.log_density(after)

    return propose


def split_r_hat(samples: Array) -> Array:
    """Split R-hat (n,) of chains (steps, chains, n): √(V/W) over half chains; 1 where all agree.

    Walkers of one ensemble sampler are not independent chains; each half of each is compared with the others all the
    same, which shows drift. Source: Gelman et al. (2013), § 11.4.
    """
    half = len(samples) // 2
    chains = np.concatenate([samples[:half], samples[half : 2 * half]], axis=1)
    within = chains.var(axis=0, ddof=1).mean(axis=0)
    between = half * chains.mean(axis=0).var(axis=0, ddof=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.sqrt(((half - 1) / half * within + between / half) / within))


def effective_sample_size(samples: Array) -> Array:
    """Effective number of independent draws (n,) in chains (steps, chains, n), for the mean.

    steps · chains / τ with τ = 1 + 2 Σ ρ_t, ρ_t the autocorrelation averaged over the chains and about the common mean,
    summed while pairs ρ_{2t} + ρ_{2t+1} are positive and decreasing (Geyer 1992, Stat. Sci. 7, 473).
    """
    steps, chains, n = samples.shape
    centred = samples - samples.mean(axis=(0, 1))
    size = 1 << (2 * steps - 1).bit_length()
    spectrum = np.fft.rfft(centred, size, axis=0)
    covariance = np.fft.irfft(np.abs(spectrum) ** 2, size, axis=0)[:steps].mean(axis=1) / steps
    with np.errstate(invalid="ignore", divide="ignore"):
        rho = covariance / covariance[0]
    pairs = rho[: steps // 2 * 2].reshape(-1, 2, n).sum(axis=1)
    positive = np.minimum.accumulate(np.where(np.cumprod(pairs > 0, axis=0), pairs, 0.0), axis=0)
    tau = np.maximum(2 * positive.sum(axis=0) - 1, 1.0 / (steps * chains))
    return np.asarray(steps * chains / tau)
