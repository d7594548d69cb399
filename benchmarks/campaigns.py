"""Populations of bubbles whose single posteriors are exact: are medians and spreads held, and whom does it name as odd?

    python benchmarks/campaigns.py synthetic [--n 200] [--seed 1] [--bubbles 3 6 12 40] [--kinds …] [--minutes 9]
    python benchmarks/campaigns.py pairs [--n 100] [--seed 1] [--bubbles 6 12]
    python benchmarks/campaigns.py odd [--n 10] [--seed 1] [--bubbles 12]
    python benchmarks/campaigns.py power [--n 400] [--seed 1] [--bubbles 6 12 40]
    python benchmarks/campaigns.py halves RUN_DIR [--splits 10]

``synthetic``: of every bubble G and μ, in units of their priors, are read with errors of their own, and with two modes
in every third (an alias that its likelihood knows of); all readings are shifted by scale, density and pressure, drawn
from their stated priors. Posteriors are Gaussian mixtures in closed form; as many draws of them enter as a run has
effective ones, and all behind them is the program's. ``normal``: mean, spread and odd bubbles as the hierarchy
supposes. ``like``: bubbles that differ by a tenth of the prior, as of one gel. ``heavy``: the same by Student's t of
three degrees. ``gel``, ``scale``, ``law``: ``like`` with one bubble of four times the modulus, of radii 8 % too large,
of a gel that stiffens. Beside those named stands the best test there is: the odds of each bubble with median, spread
and common quantities known, and a bound that 5 % of the ``like`` campaigns exceed.

``pairs``: two gels, the second 30 % stiffer, whose readings are shifted by the same scale, density and pressure: is the
difference held, how often is it seen, what does the first gain where the second is known to 4 %, beside the closed form
of a linear hierarchy of known spread, and what is held where these three are taken to be right?

``odd``: synthetic laser bubbles of one gel (G and μ differ by 20 %, errors of 1 %, the wide priors of ``init``), whose
posteriors are sampled by forward runs; the first as it is, of four times the modulus, of a gel that stiffens, of
another gel, its radii or times 8 % too large.

``power``: what can be seen at all? The hierarchy of G alone, what is common included in its median, by quadrature over
median and spread, without draws: the share of odd bubbles that are named, and that would be by the best test, where the
spread is unknown and where it is known, of errors as above and of 6 to 16 %. The best test is the ratio of the odds
with a bound that 5 % of clean campaigns of two such parameters exceed.

``halves``: the bubbles of a finished run are sampled once, and split at random into halves with a population each.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from laser_twin import PARAMETERS, POLYTROPIC
from records import Record, fill
from scipy.optimize import least_squares
from scipy.stats import kstest, norm

from en4dvar.data.noise import noise_of
from en4dvar.data.observations import Observations
from en4dvar.ensemble.forecast import forecast
from en4dvar.estimation.population import Effort, HyperPrior
from en4dvar.estimation.population.campaign import CampaignPopulation, population_from, sampled_sets
from en4dvar.estimation.population.contrast import Centre, drawn_together, without_pull
from en4dvar.estimation.population.hierarchy import A_SET, RAISED, named
from en4dvar.estimation.population.own import ENOUGH, KEPT, OwnDraws
from en4dvar.model.function_model import FunctionModel
from en4dvar.model.state import TIME_SHIFT, Array, Parameter
from en4dvar.priors.prior import Prior, PriorTerm
from en4dvar.problem import InverseProblem
from en4dvar.runs.finished import finished
from en4dvar_bubble import QuadraticKelvinVoigt

NAMES, COMMON = ("G", "mu"), ("scale", "rho", "p_inf")
LOG_STD = 2.0  # of the priors of G and μ
LIKE, FREEDOM = 0.1, 3.0  # spread of bubbles of one gel, in units of the prior; degrees of freedom of heavy tails
STIFFER, KNOWN = 1.3, 0.04  # of the second gel of a pair; how well its modulus is known
ERRORS = (0.03, 0.15)  # of single bubbles: G to 6 to 30 %
ALIAS = np.array([0.8, -0.8])  # of the second mode
# Slopes of ln G and ln μ with the logarithms of the common quantities, times their stated priors (2, 1, 1 %); how far
# off an odd bubble is in both, and its errors over those of the others: least squares on bubbles of 400 µm and 8 kPa
SLOPES = np.array([[14.0, -7.0, 6.5], [2.3, -0.8, 0.2]]) * [0.02, 0.01, 0.01] / LOG_STD
SHIFTS = {
    "gel": ((np.log(4), 0.0), (0.4, 1.0)),
    "scale": ((0.82, 0.16), (0.6, 1.0)),
    "law": ((1.35, 0.3), (0.35, 0.7)),
}
KINDS = ("normal", "like", "heavy", *SHIFTS)
OFF, STIFFENING, OTHER = 1.08, 0.5, (2.1 / 7.7, 0.118 / 0.101)  # of the odd one; soft over stiff polyacrylamide
REAL = ("clean", "gel", "law", "other", "scale", "clock")


def nothing(values: dict[str, float], times: Array) -> Array:
    return 0.0 * times


def bubble(name: str, common: Sequence[str] = COMMON) -> InverseProblem:
    """What a population asks of a data set beside its draws: its name and priors."""
    parameters = [Parameter(n, "1") for n in NAMES] + [Parameter(n, "1", common=True) for n in common]
    model = FunctionModel(nothing, parameters, {"y": "1"})
    none = np.zeros(2)
    data = Observations(np.array([0.0, 1.0]), none, noise_of(none + 1.0, none), none + 1.0, name=name)
    prior = Prior(tuple(PriorTerm.normal(p, 0.0, 1.0) for p in parameters))
    return InverseProblem(model, model.observables[0], data, prior)


@dataclass(frozen=True)
class Campaign:
    """Readings ``y`` (S, 2) with errors (S, 2), ``aliased`` (S,) where there are two modes, and the truth: ν and τ
    (2,), θ (3,), and which are ``odd``.
    """

    y: Array
    error: Array
    aliased: Array
    nu: Array
    tau: Array
    theta: Array
    odd: list[int]

    def drawn(self, rng: np.random.Generator, slopes: Array = SLOPES) -> list[OwnDraws]:
        """Draws of each bubble, which takes the common quantities of ``slopes`` (2, c) as uncertain."""
        each = zip(self.y, self.error, self.aliased, strict=True)
        return [own_draws_of(y, error, aliased, rng, slopes) for y, error, aliased in each]

    def odds(self) -> Array:
        """(S,) of being odd, with ν, τ, θ and the errors known."""
        hyper = HyperPrior()
        variance, middle = self.tau**2 + self.error**2, self.nu + SLOPES @ self.theta
        wider, wide = variance + hyper.mean_std**2, 1 + self.error**2
        of_it, elsewhere = self._density(middle, variance), np.zeros(len(self.y))
        for j in range(2):
            one = np.where(np.arange(2) == j, wider, variance)
            elsewhere = elsewhere + self._density(middle, one) / 4
        elsewhere = elsewhere + self._density(SLOPES @ self.theta, wide) / 2
        return np.asarray(hyper.odd / (1 - hyper.odd) * elsewhere / of_it)

    def _density(self, middle: Array, variance: Array) -> Array:
        first, second = (norm(middle, np.sqrt(variance)).pdf(y).prod(axis=1) for y in (self.y, self.y - ALIAS))
        return np.asarray(np.where(self.aliased, (first + second) / 2, first))


def own_draws_of(y: Array, error: Array, aliased: bool, rng: np.random.Generator, slopes: Array) -> OwnDraws:
    """Draws of (x, θ) given y = x + slopes θ + error, and perhaps the alias, x and θ being N(0, I)."""
    H = np.column_stack([np.eye(2), slopes])
    S = H @ H.T + np.diag(error**2)
    gain = H.T @ np.linalg.inv(S)
    left = np.eye(len(gain)) - gain @ H
    readings = [y, y - ALIAS] if aliased else [y]
    logs = np.array([-0.5 * r @ np.linalg.solve(S, r) for r in readings])
    share = np.exp(logs - np.logaddexp.reduce(logs))
    count = int(ENOUGH)
    means = np.array([gain @ r for r in readings])[rng.choice(len(readings), count, p=share)]
    z = means + rng.multivariate_normal(np.zeros(len(gain)), left, count)
    return OwnDraws(z[rng.integers(count, size=KEPT)], float(np.logaddexp.reduce(logs)), float(count), 0)


def campaign(
    kind: str, bubbles: int, rng: np.random.Generator, truth: tuple[Array, Array] | None = None,
    errors: tuple[float, float] = ERRORS,
) -> Campaign:  # fmt: skip
    """Of one kind; ``truth``: θ and ν, instead of drawn."""
    hyper = HyperPrior()
    theta, nu = truth or (rng.standard_normal(len(COMMON)), hyper.mean_std * rng.standard_normal(2))
    tau = hyper.spread * np.abs(rng.standard_normal(2)) if kind == "normal" else np.full(2, LIKE)
    heavy = rng.standard_t(FREEDOM, (bubbles, 2)) / np.sqrt(FREEDOM / (FREEDOM - 2))
    x = nu + tau * (heavy if kind == "heavy" else rng.standard_normal((bubbles, 2)))
    error, odd = rng.uniform(*errors, (bubbles, 2)), []
    if kind in SHIFTS:
        shift, wider = SHIFTS[kind]
        x[0] += np.array(shift) / LOG_STD
        error[0] *= wider
        odd = [0]
    if kind == "normal":
        odd = np.flatnonzero(rng.uniform(size=bubbles) < hyper.odd).tolist()
        for i in odd:  # as if it belonged to none, or elsewhere in one parameter
            where = rng.choice(3, p=[0.5, 0.25, 0.25])
            x[i] = rng.standard_normal(2) if where == 0 else x[i]
            x[i, where - 1] += hyper.mean_std * rng.standard_normal() * (where > 0)
    aliased = np.arange(bubbles) % 3 == 2
    y = x + SLOPES @ theta + error * rng.standard_normal((bubbles, 2))
    y[aliased] += ALIAS * (rng.uniform(size=(int(aliased.sum()), 1)) < 0.5)
    return Campaign(y, error, aliased, nu, tau, theta, odd)


def found_of(
    drawn: Sequence[OwnDraws], seed: int, problems: Sequence[InverseProblem] = (), names: Sequence[str] = COMMON
) -> CampaignPopulation:
    problems = problems or [bubble(f"bubble{i}", names) for i in range(len(drawn))]
    start = [draws.z for draws in drawn]
    return population_from(dict(enumerate(drawn)), {}, start, problems, NAMES, seed, HyperPrior(), Effort())


def synthetic(seed: int, key: str) -> Record:
    """Ranks of the truth among the draws, and who is named."""
    kind, bubbles, number = key.split("/")
    rng = np.random.default_rng([seed, KINDS.index(kind), int(bubbles), int(number)])
    of_it = campaign(kind, int(bubbles), rng)
    began = time.process_time()
    result = found_of(of_it.drawn(rng), int(number))
    quantiles = np.array([one.quantiles for one in result.empirical])
    return {
        "nu": np.mean(result.posterior.nu < of_it.nu, axis=0),
        "tau": np.mean(result.posterior.tau < of_it.tau, axis=0),
        "robust": (quantiles[:, 0] < of_it.nu) & (of_it.nu < quantiles[:, 2]),
        "odd": of_it.odd,
        "chances": 1 - result.belongs,
        "odds": of_it.odds(),
        "size": result.estimate.size,
        "width": np.diff(np.quantile(result.posterior.nu[:, 0], [0.05, 0.95]))[0],
        "seconds": time.process_time() - began,
    }


def pairs(seed: int, key: str) -> Record:
    """Ranks of the difference of two medians and of that of the first, without and with the second known."""
    bubbles, number = map(int, key.split("/")[1:])
    rng = np.random.default_rng([seed, len(KINDS), bubbles, number])
    theta, nu = rng.standard_normal(len(COMMON)), rng.standard_normal(2)
    apart = np.array([np.log(STIFFER) / LOG_STD, 0.0])
    gels = [campaign("like", bubbles, rng, (theta, gel)) for gel in (nu, nu + apart)]
    results = [found_of(gel.drawn(rng), number) for gel in gels]
    right = found_of(gels[0].drawn(rng, np.empty((2, 0))), number, names=())  # as if nothing were off
    error = KNOWN / LOG_STD
    known = [(0, nu[0] + apart[0] + error * rng.standard_normal(), error)]

    def centre(i: int, *told: tuple[int, float, float]) -> Centre:
        r = results[i]
        return without_pull(0, r.posterior.nu, r.theta, r.common, r.hyper.mean_std, r.estimate.size, number, told)

    both = drawn_together([centre(0), centre(1)], number)
    alone, told = drawn_together([centre(0)], number), drawn_together([centre(0), centre(1, *known)], number)
    other = drawn_together([centre(1)], number + 1)
    columns = {"difference": both[:, 1] - both[:, 0], "alone": alone[:, 0], "calibrated": told[:, 0]}
    columns["right"] = right.posterior.nu[:, 0]
    truth = {"difference": apart[0], "alone": nu[0], "calibrated": nu[0], "right": nu[0]}
    own = [1 / np.sum(1 / (LIKE**2 + gel.error[:, 0] ** 2)) for gel in gels]  # variances of the medians, θ known
    shared, reference = SLOPES[0] @ SLOPES[0], own[1] + error**2
    return {
        **{name: np.mean(x < truth[name]) for name, x in columns.items()},
        **{f"{name} std": x.std() for name, x in columns.items()},
        "apart std": (other - alone).std(),
        "closed std": np.sqrt(own[0] + shared * reference / (shared + reference)),
        "stiffer": np.mean(columns["difference"] > 0),
    }


def table_of_pairs(records: Sequence[Record], sizes: Sequence[int]) -> None:
    print("| bubbles a gel | pairs | difference of ln G inside 90 % | its std (were nothing common) ", end="")
    print("| stiffer with over 95 % | ln G of the first inside 90 % | std | calibrated inside 90 % | std ", end="")
    print("| closed form | inside 90 %, as if scale, density and pressure were right | std |")
    print("|---|---|---|---|---|---|---|---|---|---|---|---|")
    for size in sizes:
        of_it = [r for r in records if r["key"].startswith(f"pair/{size}/")]
        names = ("difference", "alone", "calibrated", "right")
        inside = {n: f"{100 * np.mean([abs(r[n] - 0.5) < 0.45 for r in of_it]):.0f} %" for n in names}
        std = {n: f"{LOG_STD * np.median([r[f'{n} std'] for r in of_it]):.2f}" for n in (*names, "apart", "closed")}
        cells = [
            size, len(of_it), inside["difference"], f"{std['difference']} ({std['apart']})",
            f"{100 * np.mean([r['stiffer'] > 0.95 for r in of_it]):.0f} %", inside["alone"], std["alone"],
            inside["calibrated"], std["calibrated"], std["closed"], inside["right"], std["right"],
        ]  # fmt: skip
        print(f"| {' | '.join(map(str, cells))} |")


def table_of(records: Sequence[Record], kinds: Sequence[str], sizes: Sequence[int]) -> None:
    print("| campaigns | bubbles | number | ranks of the median, p | median inside 90 % | spread inside 90 % ", end="")
    print("| one by one, 90 % | fewer than 100 draws | the odd one named | by the best test | others named | s |")
    print("|---|---|---|---|---|---|---|---|---|---|---|---|")
    for kind in kinds:
        for size in sizes:
            of_it = [r for r in records if r["key"].startswith(f"{kind}/{size}/")]
            if not of_it:
                continue
            nu, tau, robust = (
                np.array([r[key] for r in of_it], dtype=float).ravel() for key in ("nu", "tau", "robust")
            )
            clean = [max(r["odds"]) for r in records if r["key"].startswith(f"like/{size}/")]
            seen = [named(1 - np.array(r["chances"]), HyperPrior().odd) for r in of_it]
            odd = [(i in found, r["odds"][i]) for r, found in zip(of_it, seen, strict=True) for i in r["odd"]]
            best = [odds > np.quantile(clean, 0.95) for _, odds in odd] if clean else []
            others = [bool(set(found) - set(r["odd"])) for r, found in zip(of_it, seen, strict=True)]
            cells = [
                kind, size, len(of_it), f"{min(kstest(nu[i::2], 'uniform').pvalue for i in (0, 1)):.3f}",
                *(f"{100 * np.mean(np.abs(u - 0.5) < 0.45):.0f} %" for u in (nu, tau)), f"{100 * robust.mean():.0f} %",
                sum(r["size"] < 100 for r in of_it), _share([found for found, _ in odd]), _share(best), _share(others),
                f"{np.median([r['seconds'] for r in of_it]):.1f}",
            ]  # fmt: skip
            print(f"| {' | '.join(map(str, cells))} |")


def _share(of: Sequence[bool]) -> str:
    return f"{100 * np.mean(of):.0f} %" if len(of) else "–"


def raised(bubbles: int, kind: str, count: int, errors: tuple[float, float], tau: Array, seed: int) -> Array:
    """(count, S) by what factor the readings of G raise the odds of each bubble in as many campaigns; τ is one of
    ``tau`` (T,), the first bubble of a ``kind``.
    """
    rng, hyper, slots = np.random.default_rng([seed, bubbles]), HyperPrior(), (..., None, None)
    each = [campaign(kind, bubbles, rng, (np.zeros(3), np.zeros(2)), errors) for _ in range(count)]
    nu, middle = np.linspace(-0.7, 0.7, 41), np.array([0.5, 0.25]) * hyper.odd
    log_prior = np.log(tau) - 0.5 * (tau / hyper.spread) ** 2
    found = []
    for one in each:
        y, error, aliased = one.y[:, 0][slots], one.error[:, 0][slots], one.aliased[slots]

        def likely(variance: Array, y: Array = y, error: Array = error, aliased: Array = aliased) -> Array:
            std = np.sqrt(error**2 + variance)
            first, second = (norm.pdf(reading, nu[:, None], std) for reading in (y, y - ALIAS[0]))
            return np.asarray(np.where(aliased, (first + second) / 2, first))

        belongs, elsewhere = (1 - hyper.odd) * likely(tau**2), middle[1] * likely(tau**2 + hyper.mean_std**2)
        logs = np.log(belongs + elsewhere).sum(axis=0) + log_prior
        weights = np.exp(logs - logs.max())
        share = np.sum(weights * elsewhere / (belongs + elsewhere), axis=(1, 2)) / weights.sum()
        found.append(share / (1 - share) * (1 - hyper.odd) / hyper.odd)
    return np.array(found)


def power(seed: int, sizes: Sequence[int], count: int) -> None:
    print("| errors of G | bubbles | the first | named | by the best test | spread known | others named |")
    print("|---|---|---|---|---|---|---|")
    unknown, known = np.geomspace(0.02, 2.0, 21), np.array([LIKE])
    for errors in (ERRORS, (0.03, 0.08)):
        for size in sizes:
            clean = [raised(size, "like", count, errors, tau, seed).max(axis=1) for tau in (unknown, known)]
            bounds = [np.quantile(highest, 0.975) for highest in clean]
            limit = max(RAISED, A_SET * size)
            false = 1 - np.mean(clean[0] < limit) ** 2  # of G or of μ
            for kind in SHIFTS:
                first = [raised(size, kind, count, errors, tau, seed + 1)[:, 0] for tau in (unknown, known)]
                shares = [_share(of.tolist()) for of in (first[0] > limit, first[0] > bounds[0], first[1] > bounds[1])]
                about = f"{100 * LOG_STD * errors[0]:.0f} to {100 * LOG_STD * errors[1]:.0f} %"
                print(f"| {about} | {size} | {kind} | {' | '.join(shares)} | {100 * false:.0f} % |", flush=True)


def laser_bubble(name: str, times: Array, largest: float) -> InverseProblem:
    """A bubble of the priors of ``init``, without readings."""
    about = {"G": (8e3, LOG_STD), "mu": (0.1, LOG_STD), "R_eq": (0.12 * largest, 0.4)}
    terms = [PriorTerm.lognormal(PARAMETERS[n], *values) for n, values in about.items()]
    terms += [PriorTerm.normal(PARAMETERS["R_max"], largest, 0.01 * largest), PriorTerm.normal(TIME_SHIFT, 0.0, 5e-7)]
    ones = np.ones(len(times))
    data = Observations(times, ones, noise_of(0.01 * largest * ones, 0 * ones), ones, name=name)
    return InverseProblem(POLYTROPIC, POLYTROPIC.observables[0], data, Prior(tuple(terms)))


def read(name: str, x: Array, kind: str, rng: np.random.Generator) -> InverseProblem:
    """The bubble of a truth (ln G, ln μ, ln R_eq, R_max, shift), read as one of a ``kind``."""
    times, off = 3e-2 * x[3] * np.arange(1, 31), OFF if kind == "scale" else 1.0
    x = x + np.array([*np.log({"gel": (4, 1), "other": OTHER}.get(kind, (1, 1))), 0, 0, 0])
    problem = laser_bubble(name, times, x[3])
    if kind == "law":
        stiffening = replace(POLYTROPIC, law=QuadraticKelvinVoigt())
        run = forecast(replace(problem, model=stiffening, fixed={"alpha": STIFFENING}), x[None])
    else:
        run = forecast(problem, x[None])
    values = run.predictions[0] + 0.01 * x[3] * rng.standard_normal(len(times))
    fitted = laser_bubble(name, times * (OFF if kind == "clock" else 1), off * x[3])
    return replace(fitted, observations=replace(fitted.observations, values=off * values))


def members_of(problem: InverseProblem, at: Array, rng: np.random.Generator) -> Array:
    """(50, n) about the lowest minimum of J from ``at`` (n,), transformed, and from four times more or less of G; in
    white coordinates.
    """
    data, prior = problem.observations, problem.prior

    def residuals(z: Array) -> Array:
        apart = (forecast(problem, prior.from_white(z[None])).predictions[0] - data.values) / data.std
        return np.concatenate([np.nan_to_num(apart, nan=1e3), z])

    starts = [(at + np.log(more) * (np.arange(len(at)) == 0) - prior.mean) / prior.std for more in (1, 4, 0.25)]
    each = [least_squares(residuals, start, diff_step=1e-4, x_scale=1.0, max_nfev=15) for start in starts]
    found = min(each, key=lambda one: one.cost)
    return rng.multivariate_normal(found.x, np.linalg.inv(found.jac.T @ found.jac), 50)


def odd(seed: int, size: int, key: str) -> Record:
    """Who is named of the bubbles of one gel, the first of them as they are and odd in each way."""
    rng = np.random.default_rng([seed, int(key)])
    centre = np.array([np.log(8e3), np.log(0.1), np.log(50e-6), 4e-4, 0.0])
    gel = centre + np.array([0.3, 0.3, 0, 0, 0]) * rng.standard_normal(5)
    scatter = np.array([0.2, 0.2, 0.15, 2e-5, 2e-7])
    truths = gel + scatter * rng.standard_normal((size, 5))
    problems = [read(f"bubble{i}", x, "clean", rng) for i, x in enumerate(truths)]
    spoilt = {kind: read("bubble0", truths[0], kind, rng) for kind in REAL[1:]}
    start = [members_of(p, x, rng) for p, x in zip(problems, truths, strict=True)]
    drawn = sampled_sets(problems, start, seed, None, lambda words: None)[0]
    record: Record = {}
    for kind in REAL:
        first = spoilt.get(kind, problems[0])
        if kind != "clean":
            begun = members_of(first, truths[0], rng)
            drawn[0] = sampled_sets([first] * 3, [begun] * 3, seed, None, lambda words: None)[0][0]
        result = found_of([drawn[i] for i in sorted(drawn)], seed, [first, *(problems[i] for i in sorted(drawn)[1:])])
        nu = (gel[:2] - result.problems[0].prior.mean[:2]) / LOG_STD
        record[kind] = {
            "named": list(result.odd),
            "chances": 1 - result.belongs,
            "inside": np.abs(np.mean(result.posterior.nu < nu, axis=0) - 0.5) < 0.45,
            "std": [LOG_STD * drawn[0].z[:, j].std() for j in (0, 1)],
        }
    return record


def table_of_odd(records: Sequence[Record]) -> None:
    print("| the first bubble | campaigns | named | others named | medians inside 90 % | its own std of ln G, ln μ |")
    print("|---|---|---|---|---|---|")
    for kind in REAL:
        of_it = [r[kind] for r in records]
        others = [bool(set(r["named"]) - ({0} if kind != "clean" else set())) for r in of_it]
        std = np.median([r["std"] for r in of_it], axis=0)
        named = _share([0 in r["named"] for r in of_it]) if kind != "clean" else "–"
        inside = _share(np.ravel([r["inside"] for r in of_it]).tolist())
        print(f"| {kind} | {len(of_it)} | {named} | {_share(others)} | {inside} | {std[0]:.2f}, {std[1]:.2f} |")


def halves(run_dir: Path, splits: int) -> None:
    """|z| of the difference of the medians of two random halves, in the transformed coordinate."""
    config, sets = finished([run_dir], True, None)
    assert config.population is not None
    names, problems, start = config.population.of, [s.problem for s in sets], [s.white for s in sets]
    drawn, left_out = sampled_sets(problems, start, config.seed, None, lambda words: print(words, flush=True))
    rng, usable = np.random.default_rng(config.seed), sorted(drawn)
    print(f"{len(usable)} of {len(sets)} data sets; z of the difference of two halves, what is common apart")
    for split in range(splits):
        order = rng.permutation(usable)
        nu = []
        for half in (order[: len(order) // 2], order[len(order) // 2 :]):
            of_half = {int(s): drawn[int(s)] for s in sorted(half)}
            result = population_from(
                of_half, left_out, start, problems, names, config.seed, config.population.hyper, Effort()
            )
            centred = result.theta - result.theta.mean(axis=0)
            told = centred @ np.linalg.lstsq(centred, result.posterior.nu, rcond=None)[0]
            nu.append(result.posterior.nu - told)  # what is common is of one value in both halves
        z = (nu[0].mean(axis=0) - nu[1].mean(axis=0)) / np.hypot(nu[0].std(axis=0), nu[1].std(axis=0))
        print(f"split {split}: " + ", ".join(f"{name} {value:+.1f}" for name, value in zip(names, z, strict=True)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("synthetic", "pairs", "odd", "power", "halves"))
    parser.add_argument("run_dir", type=Path, nargs="?")
    parser.add_argument("--n", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--bubbles", type=int, nargs="+", default=[3, 6, 12, 40])
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=KINDS)
    parser.add_argument("--splits", type=int, default=10)
    parser.add_argument("--minutes", type=float, default=9.0)
    parser.add_argument("--records", type=Path, default=Path("runs/campaigns"), help="folder of the records")
    asked = parser.parse_args()
    if asked.what == "halves":
        halves(asked.run_dir, asked.splits)
        return
    if asked.what == "power":
        power(asked.seed, asked.bubbles, asked.n)
        return
    file = asked.records / f"{asked.what}_{asked.seed}.jsonl"
    if asked.what == "odd":
        run = partial(odd, asked.seed, asked.bubbles[0])
        table_of_odd(list(fill(file, map(str, range(asked.n)), run, asked.minutes).values()))
        return
    kinds = asked.kinds if asked.what == "synthetic" else ["pair"]
    keys = [f"{kind}/{size}/{i}" for i in range(asked.n) for kind in kinds for size in asked.bubbles]
    of_it = synthetic if asked.what == "synthetic" else pairs
    records = list(fill(file, keys, partial(of_it, asked.seed), asked.minutes).values())
    if asked.what == "synthetic":
        table_of(records, kinds, asked.bubbles)
    else:
        table_of_pairs(records, asked.bubbles)


if __name__ == "__main__":
    main()
