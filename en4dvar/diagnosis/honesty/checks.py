"""Single checks: pure functions, each silent where there is nothing to say."""

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from statistics import NormalDist, median
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from en4dvar.diagnosis import diagnostics as diag
from en4dvar.diagnosis.analysis import Analysis
from en4dvar.diagnosis.honesty.widening import Wider, contradicts, farthest
from en4dvar.ensemble.members import NOT_FINITE
from en4dvar.model.forward import ValidityLimit
from en4dvar.model.state import NOISE_SCALE, Array, Mask, Parameter
from en4dvar.plumbing.caution import Caution, Severity, caution
from en4dvar.plumbing.hints import counted, listed, percent
from en4dvar.plumbing.units import convert, unit_after
from en4dvar.priors.prior import Prior, PriorTerm
from en4dvar.priors.varying.model import clock

SAME_DIRECTION = 1e-8  # relative singular value below which anomalies do not span a direction
NEAR = 0.05  # of the width of an interval
PILED_UP = 0.2  # share of members near a bound
ODD = 1e-3  # probability below which residuals are told to be odd
BEYOND = 0.1  # share of members beyond a limit of the model
MOVED, WIDENED = 0.3, 0.5  # mean in prior std, relative variance: beyond, a posterior is not its prior
SERIOUS: Severity = "serious"
THERE = 0.25  # of the errors' std: a discrepancy beyond it in nearly all members is there
NOTHING = 0.5  # of the readings' own std: a discrepancy beyond it in nearly all members leaves little explained
HARDLY = 0.1  # share of a variance: a shift of a third of the std, with which a 90 % interval holds the truth at 89 %
NINE_OF_TEN = (0.05, 0.95)
SILENT = 0.1  # DFS of all readings beyond it that count as none
EXTRAPOLATED = "no action is needed for the parameters; paths beyond the limit are extrapolated"
EXCLUDED = "no action is needed: the event was seen, so the readings exclude these members"
IMPOSSIBLE = (
    "no action is needed where these values are impossible: the posterior was sampled, given that the "
    "model runs; otherwise find out why it fails"
)
UNREAD = "no action is needed if the spread of the field shows this, cell by cell"
MANY = 0.1  # share of members whose loss is serious
BY_CHANCE = 0.01  # of cases in which a parameter is said to tell lost members from others, and does not
FAR = 1.5  # prior standard deviations from the prior mean that are worth naming for one or two members
MOST_NAMED, MOST_LISTED = 3, 6
CLOCK = "on the clock of the data"  # which shows another time than the model's, if data.time_zero says so
NONE: Mapping[str, str] = MappingProxyType({})
ONE_SIDED = 1.645  # standard deviations below which 5 % of a Gaussian lie
REACHES = 5.0  # times below its median where a prior still has 5 %: its lower end stands for a value of zero
LOWEST = 0.1  # of a posterior: what stands for its density where its prior ends
EVEN = 1 / 3  # density below half of the median over that up to it: what is less is that of a small value, known well
Findings = Iterator[Caution]


def rank(prior: Prior, members: Array, posterior: Array) -> Findings:
    """Ensembles (N, n), (N', n) whose anomalies span fewer directions than there are parameters."""
    n = members.shape[1]
    values = np.linalg.svd((members - members.mean(axis=0)) / prior.std, compute_uv=False)
    spanned = int(np.sum(values > SAME_DIRECTION * values[0])) if values.size and values[0] > 0 else 0
    if spanned < n:
        words = f"the {len(members)} prior members span {spanned} of {n} directions"
        yield caution(
            "rank-deficient", f"{words}: the posterior cannot move in the others and its spread there is zero"
        )
    elif len(posterior) <= n:
        alive = f"{counted(len(posterior), 'member')} of the posterior alive"
        yield caution("rank-deficient", f"{alive}, too few for the covariance of {n} parameters")


def fit(chi2: float, n_observations: int, total_dfs: float, factor: float = 1.0) -> Findings:
    """A residual χ² (the sum over the observations) that R does not explain. At the minimum its expectation is K − DFS,
    not K (Talagrand 1999): the fit has absorbed DFS of the noise. ``factor``: it is so many times a χ².
    """
    degrees = max(1.0, n_observations - total_dfs)
    low, high = (factor * end for end in diag.chi2_interval(degrees))
    words = f"χ² of the residuals is {chi2:.3g} where about {factor * degrees:.3g} is expected"
    if not chi2 <= high:
        yield caution("misfit", f"{words}: the model does not explain the data within the stated observation error")
    elif chi2 < low and n_observations - total_dfs > 1:
        words = f"{words}: the stated observation error is larger than the scatter of the data"
        yield caution("overstated-error", words)


def structure(analysis: Analysis) -> Findings:
    """Residuals that are not the independent numbers of one variance that they should be.

    Each probability is that of a finding at least as odd where model, prior and errors are right; :data:`ODD` keeps all
    together below half a per cent.
    """
    residuals = analysis.residuals
    if residuals is None or not residuals.enough:
        return
    runs, expected = residuals.runs
    chance = min(residuals.lag_one_chance, residuals.runs_chance)
    if chance < ODD:
        few = f", in {runs} runs of one sign where about {expected:.0f} are expected"
        words = (
            "the residuals have a structure in time: neighbours resemble each other (their correlation is "
            f"{residuals.lag_one:.2f}{few if residuals.runs_chance < ODD else ''}; probability {_chance(chance)} if "
            "the model is right): the error bars assume independent errors"
        )
        # what is missed moves an estimate by no more than |e| of its standard deviations
        small = float(np.sum((1.0 if residuals.weights is None else residuals.weights) * residuals.white**2)) < 1
        yield caution("residual-structure", words, "caution" if small else None)
    if residuals.collapse_chance < ODD:
        words = (
            "the residuals are larger where the observable changes fast (probability "
            f"{_chance(residuals.collapse_chance)} if the errors are as stated): the times or the model are wrong "
            "there, or the readings are means over several"
        )
        yield caution("odd-residuals", words)
    robust = math.isfinite(analysis.observations.noise.counts_within)
    if not robust and residuals.outlier[1] < ODD:
        which, probability = residuals.outlier
        place = int(np.flatnonzero(residuals.which == which)[0])
        words = (
            f"the reading at {moments(analysis)[which]} {CLOCK} is farther off than the scatter of the residuals "
            f"explains (probability {_chance(probability)}); by its own error it is "
            f"{abs(residuals.studentised[place]):.1f} standard deviations off, with a leverage of "
            f"{percent(residuals.leverage[place])}"
        )
        yield caution("odd-residuals", words)


def missed(analysis: Analysis) -> Findings:
    """A discrepancy that is there: what the residuals show of it widens the intervals, what parameters absorbed does
    not. Serious where it is a large part of what there is to explain; a note where no estimate depends on it.
    """
    names, amplitude = analysis.problem.prior.names, next(iter(analysis.problem.discrepancy), None)
    if amplitude is None or amplitude.name not in names:
        return
    members = analysis.posterior[:, names.index(amplitude.name)]
    low, told = np.nanquantile(members, NINE_OF_TEN[0]), diag.member_quantiles(members, NINE_OF_TEN)
    error, part = float(np.median(analysis.own_std)), analysis.problem.parts[0].where
    if not low > THERE * error:
        return
    signal = float(np.std(analysis.observations.values[part][analysis.observations.weights[part] > 0]))
    by = f"by {' to '.join(shown(end, amplitude) for end in told)} (standard deviation of the discrepancy, 5 to 95 %)"
    if low > NOTHING * signal:
        words = (
            f"the model explains little: it misses the readings {by}, while these vary by {shown(signal, amplitude)}"
        )
        yield caution("discrepancy-found", words, SERIOUS)
    else:
        words = f"the model misses the readings {by}, beside errors of {shown(error, amplitude)}"
        absorbed = "the intervals allow for what shows in the residuals, not for what the parameters have absorbed"
        own = [j for j, name in enumerate(names) if name not in analysis.problem.of_errors]
        share = max(analysis.discrepancy.shares[own, 1], default=1.0) if analysis.discrepancy and own else 1.0
        if share < HARDLY:
            words = f"{words}, which make up at most {percent(share)} of the variance of a parameter"
            yield caution("discrepancy-found", words, "note")
        else:
            yield caution("discrepancy-found", f"{words}: {absorbed}")


def moments(analysis: Analysis) -> list[str]:
    """The times (K,) of all observations on the clock of the data, in the display unit."""
    return [clock(analysis.problem.model, time) for time in analysis.observations.file_times]


def _chance(probability: float) -> str:
    return f"{probability:.1g}" if probability > 1e-6 else "below 1e-6"


def conflict(prior: Prior, centre: Array, timed: bool = False, wide: Wider | None = None) -> Findings:
    """A posterior centre (n,) far from the prior; ``timed``: the stated errors hold errors of the times, which may be
    too large; ``wide``: of :func:`far_from`."""
    terms = dict(zip(prior.names, prior.terms, strict=True))
    return far_from(terms, (centre - prior.mean) / prior.std, prior.white(centre), timed, wide)


def far_from(
    terms: Mapping[str, PriorTerm],
    z: Array,
    white: Array,
    timed: bool = False,
    wide: Wider | None = None,
) -> Findings:
    """A minimum of J that contradicts the prior (:func:`~en4dvar.diagnosis.honesty.widening.contradicts`).

    ``z`` (n,) are prior standard deviations from the mean of each of ``terms``, by what it is called; ``white`` (n,)
    are its white coordinates. ``wide``: which priors are to be how many times as wide, where that is known.
    """
    if not contradicts(z, white):
        return
    names, priors, far = list(terms), list(terms.values()), farthest(z)
    places = "; ".join(_far(names[j], priors[j], float(z[j])) for j in far)
    told = caution("prior-conflict", f"prior and data conflict: the minimum lies far from the prior mean ({places})")
    at_least, (which, factor) = "about" if wide else "at least", wide or (far[:1], math.ceil(abs(z[far[0]]) / 2))
    asked = [priors[j].parameter.name for j in which]
    yield replace(told, advice=_wider(asked, float(z[far[0]]), f"{at_least} {factor} times", timed))


def _far(name: str, term: PriorTerm, z: float) -> str:
    """Where the minimum lies and where the prior does, in the display unit."""
    p = term.parameter
    value, low, high = term.to_physical(term.mean + term.std * np.array([z, -1.0, 1.0]))
    said = f"the prior says {convert(low, p.unit, p.display_unit):.3g} to {shown(high, p)}"
    return f"{name} at {shown(value, p)} where {said}: {z:+.1f} prior standard deviations"


def _wider(names: Sequence[str], z: float, factor: str, timed: bool) -> str:
    """What to do about parameters of which the first is so many prior standard deviations from its prior mean."""
    if names[0] == NOISE_SCALE.name and z < 0:
        of_times = (
            "if a camera keeps its time better than data.error.time_std says (en4dvar track states a tenth of the "
            "exposure), put its jitter there (--set data.error.time_std='3 ns')"
        )
        return (
            "state in data.error only the independent error of a reading: they scatter far less than stated. An "
            "error that all share belongs to a parameter (reading_scale, reading_offset); "
            + (of_times if timed else "for a movie, give its --exposure to en4dvar track")
        )
    priors, keys = " and ".join(names), " and ".join(f"parameters.{name}" for name in names)
    return f"check units and data; if both are right, make the prior of {priors} {factor} as wide ({keys}) and say so"


def shown(value: float, p: Parameter) -> str:
    """A value, SI, in the display unit, with that unit."""
    return f"{convert(value, p.unit, p.display_unit):.3g}{unit_after(p.display_unit)}"


def at_bound(prior: Prior, members: Array, posterior: Array, failures: Sequence[str]) -> Findings:
    """Posterior members that pile up at a bound: within 5 % of the interval's width (of a half-line's, the prior std).

    Members that failed because the parameter left its bounds count as piled up. A lognormal has no bound to pile up
    at: zero is infinitely far in ln θ. The prior's own share near the bound is no finding, three times it is.
    """
    for j, (term, parameter) in enumerate(zip(prior.terms, prior.parameters, strict=True)):
        low, high = term.bounds if term.has_bound else parameter.bounds
        low, high = np.where(term.unreached, (-math.inf, math.inf), (low, high)).tolist()
        if math.isinf(low) and math.isinf(high):
            continue
        before, after = term.to_physical(members[:, j]), term.to_physical(posterior[:, j])
        width = high - low if math.isfinite(high - low) else float(before.std())
        outside = np.array([reason.startswith(f"{parameter.name} outside") for reason in failures], dtype=bool)
        for bound, side, sign in ((low, "lower", 1), (high, "upper", -1)):
            if not math.isfinite(bound):
                continue
            near = sign * (after - bound) <= NEAR * width
            share = float(np.mean(near & (outside | (sign * (after - bound) >= 0))))
            usual = float(np.mean(sign * (before - bound) <= NEAR * width))
            if share >= PILED_UP and share > 3 * usual:
                words = f"{percent(share)} of the posterior members of {parameter.name} pile up at its {side} bound"
                yield caution("at-bound", f"{words} ({shown(bound, parameter)})", parameters=(parameter.name,))


def validity(limits: Sequence[ValidityLimit], extremes: Array, since: Array, times: Array, leverage: Array) -> Findings:
    """Posterior members (N, V) whose path leaves what the model's equations assume, ``since`` (N, V) when.

    Serious where readings that lie beyond inform: ``leverage`` (K,) at ``times`` (K,) is the share of each in its own
    prediction, and sums to the DFS of the data. A system at rest, say, tells nothing.
    """
    for v, limit in enumerate(limits if extremes.size else ()):
        reached = extremes[:, v]
        beyond = reached > limit.value
        if np.mean(beyond) <= BEYOND:
            continue
        unit = unit_after(limit.unit)
        words = (
            f"{beyond.sum()} of {len(reached)} posterior members leave the model's validity: {limit.label} reaches "
            f"{np.max(reached):.3g}{unit} (median {median(reached.tolist()):.3g}), the limit is "
            f"{limit.value:g}{unit}"
        )
        later = np.mean(times >= since[:, v, None], axis=0) > BEYOND
        informed = float(leverage[later].sum())
        words += f"; {later.sum()} of {len(times)} readings lie beyond, with {informed:.2g} of {leverage.sum():.2g} DFS"
        if informed > SILENT:
            yield caution("model-validity", words)
        else:
            yield replace(caution("model-validity", words, "note"), advice=EXTRAPOLATED)


def information(
    prior: Prior, posterior: Array, per_parameter: Array, silent: Collection[str] = (), modes: Mapping[str, str] = NONE
) -> Findings:
    """Parameters of which the data say little: neither spread nor mean of the posterior (N, n) differ from the prior's.

    ``per_parameter`` (n,) is 1 − posterior over prior variance. Nothing is said of ``silent`` names: their members
    may not be the posterior, or come from modes apart, or they need not be informed. ``modes`` says of which field a
    name is a mode: those of a field are counted in one finding.
    """
    of_fields: dict[str, list[str]] = {}
    moved = np.abs(posterior.mean(axis=0) - prior.mean) / prior.std
    for name, value, far in zip(prior.names, per_parameter, moved, strict=True):
        if name not in silent and -WIDENED < value < diag.HARDLY_INFORMED and far < MOVED:
            if name in modes:
                of_fields.setdefault(modes[name], []).append(name)
                continue
            words = f"{name} is hardly informed by the data (DFS {value:z.2f}): its posterior is close to its prior"
            yield caution("not-informed", words, parameters=(name,))
    for field, names in of_fields.items():
        count = sum(of == field for of in modes.values())
        words = f"{len(names)} of {count} modes of the initial {field} are hardly informed by the data"
        yield replace(caution("not-informed", words, parameters=tuple(names)), advice=UNREAD)


def limits(prior: Prior, sample: Array, members: Array, silent: Collection[str]) -> Findings:
    """Positive parameters, but for ``silent`` names, that readings limit only from above: as far as their priors reach
    down, the lowest values explain the readings as well as others. ``sample`` (N, n), transformed, and ``members``
    (M, n), physical, are of the posterior; limits are those of the tables, by the members.

    With u the share of the prior below a value, the density of u in the posterior at u = 0 is the evidence of the model
    with the lowest value over that of any (Dickey 1971, Ann. Math. Stat. 42, 204). Other parameters may make up for it:
    of G and α the readings may know the product alone. It is that of the lowest tenth of the posterior, and stands for
    that at zero only where it is about as high as next to the median: a small value may be known well.
    """
    for j, (name, term) in enumerate(zip(prior.names, prior.terms, strict=True)):
        low, middle = term.to_physical(term.mean + term.std * np.array([-ONE_SIDED, 0.0]))
        if name in silent or min(term.parameter.bounds[0], low) < 0 or REACHES * low > middle:
            continue
        u = np.array([NormalDist(term.mean, term.std).cdf(x) for x in sample[:, j]])
        ratio = LOWEST / max(float(np.quantile(u, LOWEST)), 1e-12)
        if ratio >= 1 and 4 * float(np.mean(u < np.median(u) / 2)) > EVEN:
            most = shown(float(diag.member_quantiles(members[:, j], (0.95,))[0]), term.parameter)
            words = (
                f"the readings limit {name} only from above: the lowest values that its prior allows, with whatever "
                f"values of other parameters go with them, explain them as well (evidence ratio {ratio:.2g}); "
                f"with this prior {name} is below {most} with a probability of 95 %"
            )
            yield caution("upper-limit", words, parameters=(name,))


def gaussian(prior: Prior, members: Array, shape: Mapping[str, float], approximate: str = "") -> Findings:
    """Members (N, n), physical and alive, whose mean, spread or ends are not the posterior's.

    Sizes are those of the numbers that are printed, for G of G and not of ln G: ``shape`` holds mean and std of the
    posterior by an emulator or by weights, and 5 and 95 % points. The finding is about the parameters that are off, and
    serious where one is off by much. ``approximate``: what a scheme does that is no posterior even where this is
    Gaussian.
    """
    if not shape.get("non_gaussian", diag.is_non_gaussian(shape)):
        return
    sizes, off, severity = [], [], SERIOUS if shape.get("tail_elsewhere") else None
    why = f"the scheme {approximate}" if approximate else "the posterior is far from Gaussian"
    words = f"{why}: mean and spread of the ensemble are not the posterior's"
    by = "emulated" if shape.get("emulator_fit", 0.0) >= diag.EMULATED_ENOUGH else "tail"
    told = [(j, p) for j, p in enumerate(prior.parameters) if f"{by}_mean_{p.name}" in shape]
    ends = [(j, p) for j, p in enumerate(prior.parameters) if f"tail_q95_{p.name}" in shape and (j, p) not in told]
    if ends and not told:
        words = f"{why}: the ends of the intervals of the ensemble are not the posterior's"
    elif not told:
        words = (
            f"{why} (effective share of members {shape['gaussian_fit']:.2f}): mean and spread of the ensemble may be "
            "off by more than they say"
        )
    for j, p in told:
        std = shape[f"{by}_std_{p.name}"]
        shift = (float(members[:, j].mean()) - shape[f"{by}_mean_{p.name}"]) / std
        ratio = float(members[:, j].std(ddof=1)) / std
        if by == "tail" or abs(shift) > diag.MEAN_OFF or abs(ratio - 1) > diag.SPREAD_OFF:
            off.append(p.name)
            sizes.append(_both(p, members[:, j], shape, by))
            if abs(shift) > 1 or ratio <= 0.5 or ratio >= 2:  # where they are known
                severity = SERIOUS
    for j, p in ends:
        off.append(p.name)
        sizes.append(_ends(p, members[:, j], shape))
    more = f": {'; '.join(sizes)}" if sizes else ""
    if by == "tail" and told and math.isnan(shape[f"tail_mean_{off[0]}"]):
        more += f"; weighted, only {shape['tail_members']:.2g} members count: too few to say what these should be"
    yield caution("non-gaussian", f"{words}{more}", severity, tuple(off))


def _both(p: Parameter, members: Array, shape: Mapping[str, float], by: str) -> str:
    """Mean ± std of the members and of the posterior, ``by`` an emulator or weights (NaN: not known), as displayed."""
    estimate, spread = shape[f"{by}_mean_{p.name}"], shape[f"{by}_std_{p.name}"]
    rather = "" if math.isnan(estimate) else f" where it should be about {_two(p, ' ± ', estimate, spread)}"
    return f"{p.name} = {_two(p, ' ± ', members.mean(), members.std(ddof=1))}{rather}"


def _ends(p: Parameter, members: Array, shape: Mapping[str, float]) -> str:
    """The 5 and 95 % points of the members and of the posterior, as displayed."""
    is_now = _two(p, " to ", *diag.member_quantiles(members, NINE_OF_TEN))
    rather = _two(p, " to ", shape[f"tail_q05_{p.name}"], shape[f"tail_q95_{p.name}"])
    return f"5–95 % of {p.name} is {is_now} where it should be about {rather}"


def _two(p: Parameter, between: str, first: float, second: float) -> str:
    """Two values of a parameter, SI, as displayed, with the unit behind."""
    numbers = (f"{convert(float(v), p.unit, p.display_unit):.2g}" for v in (first, second))
    return f"{between.join(numbers)}{unit_after(p.display_unit)}"


def down_weighted(analysis: Analysis) -> Findings:
    """Observations that a robust cost counts less; :data:`MOST_LISTED` are listed."""
    weights = analysis.down_weights
    if weights is None or not np.any(weights < 1):
        return
    lighter, moment, within = np.flatnonzero(weights < 1), moments(analysis), analysis.observations.noise.counts_within
    worst = lighter[np.argsort(weights[lighter], kind="stable")]
    left = analysis.problem.observations.values - analysis.centre_predictions
    left = np.abs(left if analysis.discrepancy is None else left - analysis.discrepancy.mean) / analysis.own_std
    off = (f"{moment[k]} ({left[k]:.2g} std off, weight {weights[k]:.2g})" for k in worst)
    where, lie = listed(off, MOST_LISTED), "lies" if len(worst) == 1 else "lie"
    beyond = f"{len(worst)} of {len(weights)} observations {lie} beyond {within:g} standard deviations"
    yield caution("down-weighted", f"{beyond}, down-weighted: at {where} {CLOCK}")


def weighted(analysis: Analysis) -> Findings:
    """Weights other than 0, which leaves a reading out, and 1, which counts it once."""
    weights = analysis.problem.observations.weights
    odd = weights[(weights != 0) & (weights != 1)]
    if len(odd):
        low, high = float(odd.min()), float(odd.max())
        span = f"{low:.3g}" if low == high else f"{low:.3g} to {high:.3g}"
        words = f"{len(odd)} of {len(weights)} observations count with weights of {span}"
        yield caution("not-bayesian", f"{words}: the intervals are not those of the Bayesian posterior")


def loss(
    stage: str, failures: Sequence[str], prior: Prior, members: Array | None = None, events: bool = False,
    sampled: bool = False,
) -> Findings:  # fmt: skip
    """The members (N,) that failed in a forecast; ``failures`` are reasons, "" for members alive.

    ``members`` (N, n), transformed, are where they were run, if that tells anything. ``events``: a member that gives no
    reading lacks what was seen, and is improbable by the data instead of lost. ``sampled``: the posterior was sampled
    after this forecast, by a likelihood that is zero where the model fails.
    """
    absent = np.array([events and reason == NOT_FINITE for reason in failures], dtype=bool)
    lost = ~diag.active_members(failures) & ~absent
    reasons = diag.common_reasons([reason for reason, none in zip(failures, absent, strict=True) if not none])
    for of_it, did in ((lost, f"failed in the {stage}: {reasons}"), (absent, f"lack the event in the {stage}")):
        if not of_it.any():
            continue
        words = f"{of_it.sum()} of {len(of_it)} members {did}"
        if members is not None:
            words = f"{words}; {where_lost(prior, members, of_it)}"
        if of_it is absent or sampled:
            advice = EXCLUDED if of_it is absent else IMPOSSIBLE
            yield replace(caution("members-lost", words, "note"), advice=advice)
        else:
            yield caution("members-lost", words, SERIOUS if lost.mean() > MANY else None)


class Side(NamedTuple):
    """Nine of ten lost members, or more, have parameter ``j`` above ``edge`` (below, where not ``higher``), as so many
    ``others`` have that are alive. The ``chance`` is that of so clear a side where the parameter does not matter.
    """

    chance: float
    j: int
    higher: bool
    edge: float
    others: int


def sides_of_lost(members: Array, lost: Mask) -> list[Side]:
    """The parameters that tell lost ``members`` (N, n), physical or transformed, from the others, the clearest first.

    These are those of which the rank sum of the lost members (Mann & Whitney 1947, Ann. Math. Stat. 18, 50) would be as
    far from its expectation by chance in less than :data:`BY_CHANCE` of all cases, in any of the parameters.
    """
    n_lost, n_alive = int(lost.sum()), int((~lost).sum())
    from scipy.stats import mannwhitneyu  # where members are lost: its import takes long

    sides = []
    for j in range(members.shape[1] if min(n_lost, n_alive) > 1 else 0):
        values = members[:, j]
        rank_sum, chance = mannwhitneyu(values[lost], values[~lost])  # exact where few are on one side
        if not chance <= BY_CHANCE / members.shape[1]:
            continue
        higher = rank_sum > n_lost * n_alive / 2
        mirrored = values if higher else -values
        edge, rest = float(np.min(mirrored[lost])), mirrored[~lost]
        if edge <= float(rest.max()):  # not all on one side: most of the lost lie beyond this quantile
            edge = float(np.quantile(mirrored[lost], 0.1))
        sides.append(Side(chance, j, bool(higher), edge if higher else -edge, int(np.sum(rest > edge))))
    return sorted(sides, key=lambda side: side.chance)


def where_lost(prior: Prior, members: Array, lost: Mask) -> str:
    """Where the lost members lie, in words and display units: the parameters that tell them from the others. Of one or
    two members that no parameter tells from the others each is described.
    """
    sides = sides_of_lost(members, lost)
    if not sides:
        return _one_by_one(prior, members[lost]) if lost.sum() < 3 else "they are spread over the whole ensemble"
    named = [
        f"{prior.names[s.j]} {'above' if s.higher else 'below'} {_shown(prior, s.j, s.edge)} "
        f"({f'as {s.others}' if s.others else 'none'} of the {(~lost).sum()} others)"
        for s in sides[:MOST_NAMED]
    ]
    return f"lost members have {', '.join(named)}"


def _one_by_one(prior: Prior, members: Array) -> str:
    described = []
    for row in members:
        z = (row - prior.mean) / prior.std
        far = [j for j in np.argsort(-np.abs(z)) if abs(z[j]) > FAR][:MOST_NAMED]
        places = ", ".join(f"{prior.names[j]} = {_shown(prior, j, row[j])} ({z[j]:+.1f} prior std)" for j in far)
        described.append(f"at {places}" if places else "near the centre of the prior")
    return f"lost {' and '.join(dict.fromkeys(described))}"


def _shown(prior: Prior, j: int, x: float) -> str:
    return shown(float(prior.terms[j].to_physical(np.asarray(x))), prior.parameters[j])
