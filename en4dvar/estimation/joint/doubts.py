"""What a joint estimate says against itself: data sets that are odd, differ, are not fitted, or follow a trend.

A value of the material that rises with the size of the bubble, with the order in which data sets were taken or with the
time between readings is what a wrong scale, a wall, a drift or a wrong law leaves behind.
"""

from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace

import numpy as np

from en4dvar.diagnosis.diagnostics import chi2_interval
from en4dvar.estimation.joint.agreement import Agreement
from en4dvar.estimation.joint.problem import JointProblem, Single
from en4dvar.model.state import Array
from en4dvar.plumbing.caution import Caution, caution
from en4dvar.problem import InverseProblem

MOST_NAMES = 6
LEAST = 1e-16  # probability that is told in figures
LEAST_LEARNT = 1e-6  # of the prior's variance, by which a mode would move; below it a data set says nothing
DIFFER = 1e-3  # probability below which data sets are said not to share one value
FEWEST = 6  # data sets; of fewer no order is improbable enough
CHANCE = 0.01  # probability below which a trend is told, that any of those looked at be there by chance


def doubts(
    joint: JointProblem, border: Array, chi2: Array, agreed: Agreement, kept: Collection[int], singles: Sequence[Single]
) -> Iterator[Caution]:
    """Warnings of a joint estimate about its data sets, with the shared values ``border`` (c,) in units of the prior
    and χ² (E,) per reading; those not ``kept`` are odd.
    """
    odd = [
        f"{name} (χ² {chi2[e]:.3g} per reading, {agreed.squares[e] ** 0.5:.1f} standard deviations from all others, "
        f"probability {_chance(agreed.chances[e])})"
        for e, name in enumerate(joint.names)
        if e not in kept
    ]
    if odd:
        words = f"{_several(odd)} {'does' if len(odd) == 1 else 'do'} not share the values of the others"
        yield caution("odd-data-set", f"{words}: the estimate without stands beside", "serious")
    elif agreed.chance < DIFFER:
        by = f" by {agreed.scatter:.1f} times what their errors explain" if agreed.degrees else ""
        words = (
            f"the data sets differ{by} (probability {_chance(agreed.chance)} if they share one value): the "
            "interval of one shared value is too narrow"
        )
        of = " ".join(dict.fromkeys(f"--of {name}" for name, _ in joint.shared))
        advice = f"ask how much they vary and not for one value (en4dvar population {of})"
        if agreed.degrees:
            advice += f", or, where errors were stated too small, state them {agreed.scatter:.1f} times as large"
        yield replace(caution("data-sets-differ", words), advice=advice)
    yield from _misfits(joint, chi2, kept)
    yield from _trends(joint, border, singles)


def _misfits(joint: JointProblem, chi2: Array, kept: Collection[int]) -> Iterator[Caution]:
    """χ² of data sets under the shared values, beyond what their errors explain."""
    beyond = []
    for e in kept:
        readings = len(joint.experiments[e].observations.used)
        if chi2[e] * readings > chi2_interval(max(1.0, readings - len(joint.columns(e)[1])))[1]:
            beyond.append(f"{joint.names[e]} ({chi2[e]:.3g})")
    if beyond:
        words = f"χ² per reading under the shared values is larger than the errors explain: {_several(beyond)}"
        yield caution("misfit", words)


def _trends(joint: JointProblem, border: Array, singles: Sequence[Single]) -> Iterator[Caution]:
    """Of the shared parameters as the data sets have them alone, each held against what it should be.

    Given the shared s a linear data set of posterior covariance P, in units of the prior, has its mode at (I − P)_s s
    on average: the less its readings say, the nearer to the prior, and how much they say may well follow its size. The
    rest is counted in its standard deviations, by the noise P − P² and by its own unknowns, (I − P)_v (I − P)_vᵀ.
    """
    names = list(dict.fromkeys(name for name, _ in joint.shared))
    values = np.full((len(singles), len(names)), np.nan)
    for e, single in enumerate(singles):
        shared, own = joint.columns(e)
        covariance = np.linalg.inv(single.precision)
        learnt = np.eye(len(covariance)) - covariance
        off = single.mode - learnt[:, shared] @ border[joint.of_border(e)]
        variance = np.diag(covariance - covariance @ covariance) + np.sum(learnt[:, own] ** 2, axis=1)
        for at in shared:
            if variance[at] > LEAST_LEARNT:
                values[e, names.index(joint.experiments[e].prior.names[at])] = off[at] / np.sqrt(variance[at])
    return trends(joint.experiments, values, names)


def _chance(value: float) -> str:
    return f"{value:.1g}" if value > LEAST else f"below {LEAST:.0g}"


def _several(words: Sequence[str]) -> str:
    more = f" and {len(words) - MOST_NAMES} more" if len(words) > MOST_NAMES else ""
    return ", ".join(words[:MOST_NAMES]) + more


def trends(problems: Sequence[InverseProblem], values: Array, names: Sequence[str]) -> Iterator[Caution]:
    """Of ``values`` (S, p) of the parameters ``names`` that S data sets give one by one; NaN where one has none.

    By Kendall's rank correlation (1938, Biometrika 30, 81), whose probability is exact for few data sets. Nothing is
    said of data sets with fewer readings than parameters: each tells a combination, which its size decides.
    """
    if min((len(p.observations.used) for p in problems), default=0) < max(2, len(names)):
        return
    from scipy.stats import kendalltau  # whose import takes longer than all of this

    covariates = list(_covariates(problems))
    for j, name in enumerate(names):
        has = np.isfinite(values[:, j])
        if has.sum() < FEWEST:
            continue
        for what, along in covariates:
            if np.ptp(along[has]) == 0:
                continue
            tau, chance = kendalltau(along[has], values[has, j])
            if chance * len(covariates) * len(names) < CHANCE:
                words = (
                    f"{name} of single data sets {'rises' if tau > 0 else 'falls'} with {what} (rank correlation "
                    f"{tau:.2f}, probability {chance:.1g} by chance)"
                )
                yield caution("trend", words, parameters=(name,))


def _covariates(problems: Sequence[InverseProblem]) -> Iterator[tuple[str, Array]]:
    """What values are held against, and it (S,)."""
    yield "the order of the data sets", np.arange(len(problems), dtype=float)
    yield "the largest reading", np.array([float(p.observations.values.max()) for p in problems])
    steps = [np.median(np.diff(p.observations.instants[0])) for p in problems]
    yield "the time between readings", np.array([float(f"{x:.4g}") for x in steps])  # of one camera they are the same
