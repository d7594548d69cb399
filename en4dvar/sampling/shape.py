"""How far the posterior is from the Gaussian that an ensemble describes, by a few hundred more runs where it matters.

The members' own J, known from the posterior forecast, clear most runs. Where they do not, and the model is cheap, an
emulator of J is fitted about the ensemble and sampled: its mean and standard deviations are those of the posterior
within about a tenth, and what they differ from the ensemble's is what a Markov chain would find
(benchmarks/gaussianity.py). A Gaussian that is too narrow draws no member where the tails of the posterior are: of a
cheap model as many are run twice as far out (docs: shells).
"""

from collections.abc import Mapping

import numpy as np

from en4dvar.descent.weight_space import WeightSpace
from en4dvar.diagnosis import diagnostics as diag
from en4dvar.model.state import Array
from en4dvar.priors.prior import Prior, member_stream
from en4dvar.sampling.emulated_cost import EmulatedCost, emulate
from en4dvar.sampling.emulator import Coordinates

CHAIN_FITS = 4  # of an emulator that has to guide a chain into the tails; two tell mean and spread
SHIFT, SPREAD = 0.25, 0.15  # of the ensemble, by the emulator, that leave a doubt: half of what is warned of
FAR = 2.0  # times as far out as the members
CLEARED = 0.85  # effective share of the members above which no run was found that was off (docs: calibration)


def examine_shape(
    space: WeightSpace, ensemble: Array, mode: Array, costs: Array, seed: int, settle: bool = True
) -> dict[str, float]:
    """Numbers for :func:`~en4dvar.diagnosis.diagnostics.is_non_gaussian`, and its answer.

    ``ensemble`` (N, n) and its centre ``mode`` (n,), transformed; ``costs`` J (N,) of its members. Deterministic in
    ``seed``. ``settle``: a doubt of the emulator's is looked into with more moves of its walkers.
    ``gaussian_fit``: effective share of the members; where an emulator was needed ``mean_shift``, the largest distance
    of the ensemble's mean from the posterior's in posterior standard deviations, ``spread_ratio``, the standard
    deviation of the ensemble over the posterior's where that is farthest from 1, ``emulator_fit``, and
    ``emulated_mean_<name>``, ``emulated_std_<name>`` of each parameter, physical and SI.
    """
    shape = diag.gaussianity(ensemble, mode, costs)
    if shape["gaussian_fit"] < CLEARED:
        emulator = guide(space, ensemble, seed, fits=2)
        if emulator is not None:
            off = _off(emulator, ensemble)
            if settle and doubtful(off):  # by walkers that have not settled, as often as not
                emulator = emulator.settled(member_stream(seed, "emulator, settled"))
                off = _off(emulator, ensemble)
            shape |= {**off, "emulator_fit": emulator.share, **_displayed(space.problem.prior, emulator.draws)}
    return {**shape, "non_gaussian": diag.is_non_gaussian(shape)}


def examine_tails(space: WeightSpace, ensemble: Array, costs: Array) -> dict[str, float]:
    """``tail_ratio``, the least standard deviation of the ensemble (N, n) over the posterior's, by members of J
    ``costs`` (N,) and as many runs :data:`FAR` times as far out, weighted with the density that these are all drawn
    from: of a Gaussian posterior 1, whatever the members are.
    """
    mean = ensemble.mean(axis=0)
    far = mean + FAR * (ensemble - mean)
    x = np.concatenate([ensemble, far])
    squares = np.sum(Coordinates.about(ensemble).of(x) ** 2, axis=1)
    drawn = np.logaddexp(-0.5 * squares, -0.5 * squares / FAR**2 - x.shape[1] * np.log(FAR))
    posterior = _spread(x, -np.append(costs, space.costs(far, space.forecast(far))) - drawn)
    return {"tail_ratio": float(np.min(_spread(x, -0.5 * squares - drawn) / posterior))}


def _spread(x: Array, logs: Array) -> Array:
    """Standard deviations (n,) of points (B, n) of log weights (B,)."""
    shares = np.exp(logs - logs.max())
    shares /= shares.sum()
    return np.asarray(np.sqrt(shares @ (x - shares @ x) ** 2))


def doubtful(shape: Mapping[str, float]) -> bool:
    """True if mean or spread of the ensemble are off, by the emulator, by half of what is warned of, or the spread is
    too small by as much in view of the tails.
    """
    off = shape.get("mean_shift", 0.0) > SHIFT or abs(shape.get("spread_ratio", 1.0) - 1) > SPREAD
    return off or 1 - shape.get("tail_ratio", 1.0) > SPREAD


def _off(emulator: EmulatedCost, ensemble: Array) -> dict[str, float]:
    """How far an ensemble (N, n) is from the emulator's draws."""
    draws = emulator.draws
    std = draws.std(axis=0)
    ratio = ensemble.std(axis=0, ddof=1) / std
    return {
        "mean_shift": float(np.max(np.abs(ensemble.mean(axis=0) - draws.mean(axis=0)) / std)),
        "spread_ratio": float(ratio[np.argmax(np.abs(np.log(ratio)))]),
    }


def _displayed(prior: Prior, draws: Array) -> dict[str, float]:
    """Moments of draws (B, n) as they are printed: of G, not of ln G."""
    theta = prior.to_physical(draws)
    moments = {"mean": theta.mean(axis=0), "std": theta.std(axis=0)}
    return {
        f"emulated_{what}_{name}": float(v)
        for what in moments
        for name, v in zip(prior.names, moments[what], strict=True)
    }


def guide(space: WeightSpace, ensemble: Array, seed: int, fits: int = CHAIN_FITS) -> EmulatedCost | None:
    """An emulator of J about an ensemble (N, n); None where the settings or the model forbid."""
    wanted = space.settings.emulator
    if wanted == "off" or (wanted == "auto" and not space.problem.model.compiled):
        return None
    random = member_stream(seed, "emulator")
    return emulate(space.forecast, space.problem.prior, space.problem.observations, ensemble, random, fits)
