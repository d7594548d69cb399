r"""Does each experiment agree with all others about what they share?

What experiment e says alone of the shared s is, to second order, exp(−½ sᵀΛ_e s + h_eᵀs), its own quantities eliminated
and the prior divided out. Without it the others know s with the precision S_e = I + Σ_{i≠e} Λ_i; how far it is from
them is measured by what it would change there and what it adds to the precision,

    z_e² = δᵀ (S_e⁻¹ − S⁻¹)⁻ δ,      δ = S_e⁻¹ Σ_{i≠e} h_i − S⁻¹ Σ_i h_i,      S = S_e + Λ_e,

for Λ_e of full rank the squared difference of its own value and that of the others, in units of their covariances
together; it follows χ² if all share one s. The experiment of the largest z_e is then left out and the joint estimate
made again, which needs no quadratic form: 2 (J − J_without − J_alone), the prior of s counted once, is z_e² of linear
experiments. Only where both are improbable the experiment is odd; and the rest is tested in the same way (Hawkins 1980,
Identification of Outliers, ch. 5). Where the others scatter by more than their errors themselves, both are compared
with the others' median by an F distribution: of data sets that all differ, none is odd.

What a joint estimate says against itself follows: data sets that are odd, or else differ, are not fitted, or follow a
trend, and priors that conflict with them; where some are odd, what the estimate without them says against itself. A
value of the material that rises with the size of the bubble, with the order in which data sets were taken or with the
time between readings is what a wrong scale, a wall, a drift or a wrong law leaves behind.
"""

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtrc, fdtrc, gammaincinv

from en4dvar.diagnosis.diagnostics import chi2_interval
from en4dvar.diagnosis.honesty import checks
from en4dvar.estimation.joint.descent import Place
from en4dvar.estimation.joint.problem import JointProblem, Single
from en4dvar.model.state import Array, Indices
from en4dvar.plumbing.caution import Caution, caution
from en4dvar.plumbing.hints import listed
from en4dvar.problem import InverseProblem

ODD = 0.01  # probability below which an experiment is odd, that any of a campaign be so by chance
AT_MOST = 1 / 3  # of the experiments: more are no exceptions
TOLD = 0.01  # least share of the precision that an experiment must bring along a direction to be compared along it
SCATTER = 0.01  # probability below which the others are taken to scatter by more than their errors
OF_MEDIAN = 0.4  # efficiency of a median of squares, as a share of their degrees of freedom
MOST_NAMES = 6
LEAST = 1e-16  # probability that is told in figures
LEAST_LEARNT = 1e-6  # of the prior's variance, by which a mode would move; below it a data set says nothing
DIFFER = 1e-3  # probability below which data sets are said not to share one value
FEWEST = 6  # data sets; of fewer no order is improbable enough
CHANCE = 0.01  # probability below which a trend is told, that any of those looked at be there by chance


@dataclass(frozen=True)
class Statement:
    """What one experiment says of what is shared: ``precision`` Λ (c, c) and ``pull`` h (c,), in units of the prior;
    ``compared``: which of the shared quantities others have too.
    """

    precision: Array
    pull: Array
    compared: Indices

    @classmethod
    def of(cls, joint: JointProblem, e: int, single: Single) -> "Statement":
        """By its estimate alone, whose prior of what is shared is divided out."""
        (shared, own), at, c = joint.columns(e), joint.of_border(e), len(joint.shared)
        schur = single.precision[np.ix_(shared, shared)]
        if own:
            edge = single.precision[np.ix_(own, shared)]
            schur = schur - edge.T @ np.linalg.solve(single.precision[np.ix_(own, own)], edge)
        values, vectors = np.linalg.eigh(schur - np.eye(len(schur)))
        precision, pull = np.zeros((c, c)), np.zeros(c)
        # members are few: along a direction that they say nothing of the difference may turn negative
        precision[np.ix_(at, at)] = (vectors * np.maximum(values, 0.0)) @ vectors.T
        pull[at] = (vectors * np.where(values > 0, values + 1, 0.0)) @ vectors.T @ single.mode[shared]
        others = [j for j in at if sum(j in joint.of_border(i) for i in range(len(joint.experiments))) > 1]
        return cls(precision, pull, np.array(others, dtype=int))


@dataclass(frozen=True)
class Agreement:
    """``squares`` z² (E,) of each experiment against others, along ``freedom`` (E,) directions, and ``chances`` (E,)
    that it be as large if they share one value; NaN where there is nothing to compare.

    ``chance``: that the deviances of all be so large if they share one value. ``scatter`` of the others in units of
    their errors, known with so many ``degrees``, 0 where the errors explain it.
    """

    squares: Array
    freedom: Array
    chances: Array
    chance: float
    scatter: float
    degrees: float


def agreement(joint: JointProblem, said: Sequence[Statement], rest: Collection[int], deviances: Array) -> Agreement:
    """Of each experiment with those of ``rest``; ``deviances`` (E,): 2 (J_o + J_b of its own) more than alone."""
    squares, freedom = _squares(said, rest)
    scatter, degrees = _scatter(said, rest)
    chances = np.array([_chance(z, k, scatter, degrees) for z, k in zip(squares, freedom, strict=True)])
    each = np.array([said[e].precision for e in rest])
    more = sum(map(_learnt, each)) - _learnt(each.sum(axis=0))  # a direction that nobody learns of adds no deviance
    together = float(chdtrc(max(1.0, more), deviances[list(rest)].sum()))
    return Agreement(squares, freedom, chances, together, float(np.sqrt(scatter)), degrees)


def _learnt(precision: Array) -> float:
    """How many of the prior's directions a likelihood of this precision (c, c) tells of: tr Λ (I + Λ)⁻¹."""
    return float(np.trace(np.linalg.solve(np.eye(len(precision)) + precision, precision)))


def oddest(said: Sequence[Statement]) -> int | None:
    """The experiment that is farthest from all others, if that is improbable."""
    squares, freedom = _squares(said, range(len(said)))
    with np.errstate(invalid="ignore"):
        e = int(np.argmax(np.nan_to_num(squares / freedom)))
    return e if is_odd(said, e, float(squares[e])) else None


def is_odd(said: Sequence[Statement], e: int, square: float) -> bool:
    """Whether the z² of an experiment is improbably large beside the scatter of the others."""
    scatter = _scatter(said, [i for i in range(len(said)) if i != e])
    freedom = _squares(said, range(len(said)))[1][e]
    return bool(_chance(square, freedom, *scatter) * len(said) < ODD)


def _squares(said: Sequence[Statement], rest: Collection[int]) -> tuple[Array, Array]:
    """z² of each experiment against those of ``rest`` but itself, and along how many directions; NaN along none."""
    squares, freedom = np.full(len(said), np.nan), np.zeros(len(said))
    for e, own in enumerate(said):
        others, at = [said[i] for i in rest if i != e], own.compared
        if not (len(at) and others):
            continue
        precision = np.eye(len(own.pull)) + sum(other.precision for other in others)
        pull = sum((other.pull for other in others), start=np.zeros(len(own.pull)))
        without, with_it = np.linalg.inv(precision), np.linalg.inv(precision + own.precision)
        change = (without @ pull - with_it @ (pull + own.pull))[at]
        inverse = np.linalg.inv(np.linalg.cholesky(without[np.ix_(at, at)]))
        shares, vectors = np.linalg.eigh(inverse @ (without - with_it)[np.ix_(at, at)] @ inverse.T)
        along = (vectors.T @ inverse @ change)[shares > TOLD]
        if len(along):
            squares[e], freedom[e] = float(np.sum(along**2 / shares[shares > TOLD])), len(along)
    return squares, freedom


def _scatter(said: Sequence[Statement], rest: Collection[int]) -> tuple[float, float]:
    """The variance of experiments among themselves over that of their errors, by the median, and how many degrees of
    freedom it has; 1 and 0 where the errors explain it.
    """
    squares, freedom = (values[list(rest)] for values in _squares(said, rest))
    z, k = squares[freedom > 0], freedom[freedom > 0]
    degrees = float(k.sum() - len({j for e in rest for j in said[e].compared}))
    if degrees < 1:
        return 1.0, 0.0
    chance = chdtrc(degrees, z.sum() * degrees / k.sum())  # each is compared with a mean of which it is no part
    variance = float(np.median(z / (2 * gammaincinv(k / 2, 0.5))))
    return (variance, OF_MEDIAN * degrees) if chance < SCATTER and variance > 1 else (1.0, 0.0)


def _chance(square: float, freedom: float, scatter: float, degrees: float) -> float:
    """The probability of a z² at least as large beside others that scatter so."""
    if not freedom:
        return float("nan")
    if not degrees:
        return float(chdtrc(freedom, square))
    return float(fdtrc(freedom, degrees, square / (freedom * scatter)))


def doubts(
    joint: JointProblem, place: Place, chi2: Array, agreed: Agreement, singles: Sequence[Single]
) -> Iterator[Caution]:
    """Warnings of a joint estimate without odd data sets about its data sets and priors, with J lowest at ``place`` and
    χ² (E,) per reading there.
    """
    if agreed.chance < DIFFER:
        by = f" by {agreed.scatter:.1f} times what their errors explain" if agreed.degrees else ""
        words = (
            f"the data sets differ{by} (probability {_in_figures(agreed.chance)} if they share one value): the "
            "interval of one shared value is too narrow"
        )
        named = zip(joint.shared, joint.terms, strict=True)  # what varies is hardly a constant of medium or camera
        varying = [name for (name, _), term in named if not term.parameter.common] or [name for name, _ in joint.shared]
        of = " ".join(dict.fromkeys(f"--of {name}" for name in varying))
        advice = f"ask how much they vary and not for one value (en4dvar population {of})"
        if agreed.degrees:
            advice += f", or, where errors were stated too small, state them {agreed.scatter:.1f} times as large"
        yield replace(caution("data-sets-differ", words), advice=advice)
    yield from _misfits(joint, chi2)
    yield from _conflict(joint, place)
    yield from _trends(joint, place.border, singles)


def left_out(
    joint: JointProblem, chi2: Array, agreed: Agreement, kept: Collection[int], rest: Sequence[Caution]
) -> Iterator[Caution]:
    """Warnings where data sets that are not ``kept`` are odd: they explain what else would be said of all together, so
    that the ``rest`` is what the estimate without them says of itself.
    """
    odd = [e for e in range(len(joint.names)) if e not in kept]
    told = [
        f"{joint.names[e]} (χ² {chi2[e]:.3g} per reading, {agreed.squares[e] ** 0.5:.1f} standard deviations from all "
        f"others, probability {_in_figures(agreed.chances[e])})"
        for e in odd
    ]
    verb, them = ("does", "it") if len(odd) == 1 else ("do", "them")
    words = f"{listed(told, MOST_NAMES, longest=200)} {verb} not share the values of the others"
    yield caution("odd-data-set", f"{words}: the shared values quoted first are those without {them}", "serious")
    without = listed((joint.names[e] for e in odd), MOST_NAMES)
    yield from (replace(c, words=f"without {without}: {c.words}") for c in rest)


def _conflict(joint: JointProblem, place: Place) -> Iterator[Caution]:
    """Of data and priors, of what is shared and of what each data set has of its own."""
    terms = dict(zip(map(joint.words, joint.shared), joint.terms, strict=True))
    for e, name in enumerate(joint.names):
        own = [joint.experiments[e].prior.terms[j] for j in joint.columns(e)[1]]
        terms |= {f"{term.parameter.name} of {name}": term for term in own}
    z = np.concatenate([place.border, *place.own])
    timed = any(problem.observations.noise.timed for problem in joint.experiments)
    for told in checks.far_from(terms, z, z, timed):
        yield replace(told, advice=f"{told.advice}; then make the runs again")


def _misfits(joint: JointProblem, chi2: Array) -> Iterator[Caution]:
    """χ² of data sets under the shared values, beyond what their errors explain."""
    beyond = []
    for e, problem in enumerate(joint.experiments):
        readings = len(problem.observations.used)
        if chi2[e] * readings > chi2_interval(max(1.0, readings - len(joint.columns(e)[1])))[1]:
            beyond.append(f"{joint.names[e]} ({chi2[e]:.3g})")
    if beyond:
        words = "χ² per reading under the shared values is larger than the errors explain"
        yield caution("misfit", f"{words}: {listed(beyond, MOST_NAMES, longest=200)}")


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


def _in_figures(value: float) -> str:
    return f"{value:.1g}" if value > LEAST else f"below {LEAST:.0g}"


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
    """What values are held against, and it (S,), of readings that count."""
    counted = [(p.observations, p.observations.used) for p in problems]
    yield "the order of the data sets", np.arange(len(problems), dtype=float)
    yield "the largest reading", np.array([float(o.values[used].max()) for o, used in counted])
    steps = [np.median(np.diff(np.unique(o.times[used])) if np.ptp(o.times[used]) else 0.0) for o, used in counted]
    yield "the time between readings", np.array([float(f"{x:.4g}") for x in steps])  # of one camera they are the same
