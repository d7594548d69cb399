"""Populations of bubbles whose single posteriors are exact: are medians and spreads held, and whom does it name as odd?

    python benchmarks/campaigns.py synthetic [--n 200] [--seed 1] [--bubbles 3 6 12 40] [--kinds …] [--minutes 9]
    python benchmarks/campaigns.py pairs [--n 100] [--seed 1] [--bubbles 6 12]
    python benchmarks/campaigns.py halves RUN_DIR [--splits 10]

``synthetic``: of every bubble G and μ, in units of their priors, are read with errors of their own, and with two modes
in every third (an alias that its likelihood knows of); all readings are shifted by one common quantity, drawn from its
prior. Posteriors are Gaussian mixtures in closed form; as many draws of them enter as a run has effective ones, and all
behind them is the program's. ``normal``: mean and spread from the hyperprior, and
one of twenty bubbles from the prior. ``like``: bubbles that differ by a tenth
of the prior, as of one gel. ``heavy``: the same by Student's t of three degrees. ``odd``: ``like`` with one bubble of
four times the modulus.

``pairs``: two gels, the second 30 % stiffer, whose readings are shifted by the same common quantity: is the difference
held, how often is it seen, and what does the first gain where the second is known to 4 %?

``halves``: the bubbles of a finished run are sampled once, and split at random into halves with a population each.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
from records import Record, fill
from scipy.stats import kstest

from en4dvar.data.noise import noise_of
from en4dvar.data.observations import Observations
from en4dvar.estimation.population import Effort, HyperPrior
from en4dvar.estimation.population.campaign import CampaignPopulation, population_from, sampled_sets
from en4dvar.estimation.population.contrast import Centre, drawn_together, without_pull
from en4dvar.estimation.population.own import ENOUGH, KEPT, OwnDraws
from en4dvar.model.function_model import FunctionModel
from en4dvar.model.state import Array, Parameter
from en4dvar.priors.prior import Prior, PriorTerm
from en4dvar.problem import InverseProblem
from en4dvar.runs.finished import finished
from en4dvar.runs.population_run import ODD

KINDS = ("normal", "like", "heavy", "odd")
NAMES, COMMON = ("G", "mu"), "scale"
LOG_STD = 2.0  # of the prior of G, so that four times as much is 0.69 of it
LIKE, FREEDOM = 0.1, 3.0  # spread of bubbles of one gel, in units of the prior; degrees of freedom of heavy tails
STIFFER, KNOWN = 1.3, 0.04  # of the second gel of a pair; how well its modulus is known
ERRORS = (0.03, 0.15)  # of single bubbles: G to 6 to 30 %
SLOPES = np.array([0.1, 0.05])  # of G and μ with the common quantity
ALIAS = np.array([0.8, -0.8])  # of the second mode


def nothing(values: dict[str, float], times: Array) -> Array:
    return 0.0 * times


def bubble(name: str) -> InverseProblem:
    """What a population asks of a data set beside its draws: its name and priors."""
    parameters = [Parameter(n, "1") for n in NAMES] + [Parameter(COMMON, "1", common=True)]
    model = FunctionModel(nothing, parameters, {"y": "1"})
    none = np.zeros(2)
    data = Observations(np.array([0.0, 1.0]), none, noise_of(none + 1.0, none), none + 1.0, name=name)
    prior = Prior(tuple(PriorTerm.normal(p, 0.0, 1.0) for p in parameters))
    return InverseProblem(model, model.observables[0], data, prior)


def own_draws_of(y: Array, error: Array, aliased: bool, rng: np.random.Generator) -> OwnDraws:
    """Draws of (x, θ) given y = x + slopes θ + error, and perhaps the alias, x and θ being N(0, I)."""
    H = np.column_stack([np.eye(2), SLOPES])
    S = H @ H.T + np.diag(error**2)
    gain = H.T @ np.linalg.inv(S)
    left = np.eye(3) - gain @ H
    readings = [y, y - ALIAS] if aliased else [y]
    logs = np.array([-0.5 * r @ np.linalg.solve(S, r) for r in readings])
    share = np.exp(logs - np.logaddexp.reduce(logs))
    count = int(ENOUGH)
    means = np.array([gain @ r for r in readings])[rng.choice(len(readings), count, p=share)]
    z = means + rng.multivariate_normal(np.zeros(3), left, count)
    return OwnDraws(z[rng.integers(count, size=KEPT)], float(np.logaddexp.reduce(logs)), float(count), 0)


def campaign(
    kind: str, bubbles: int, rng: np.random.Generator, truth: tuple[float, Array] | None = None
) -> tuple[list[OwnDraws], Array, Array, list[int]]:
    """Draws of each bubble, and the truth: ν and τ (2,), and which are odd; ``truth``: θ and ν, instead of drawn."""
    hyper = HyperPrior()
    theta, nu = truth or (rng.standard_normal(), hyper.mean_std * rng.standard_normal(2))
    tau = hyper.spread * np.abs(rng.standard_normal(2)) if kind == "normal" else np.full(2, LIKE)
    heavy = rng.standard_t(FREEDOM, (bubbles, 2)) / np.sqrt(FREEDOM / (FREEDOM - 2))
    x = nu + tau * (heavy if kind == "heavy" else rng.standard_normal((bubbles, 2)))
    if kind == "odd":
        x[0, 0] += np.log(4) / LOG_STD
    alone = np.arange(bubbles) < (kind == "odd")
    if kind == "normal":  # as the hierarchy supposes
        alone = rng.uniform(size=bubbles) < hyper.odd
        x[alone] = rng.standard_normal((int(alone.sum()), 2))
    drawn = []
    for i in range(bubbles):
        error, aliased = rng.uniform(*ERRORS, 2), i % 3 == 2
        y = x[i] + SLOPES * theta + error * rng.standard_normal(2) + ALIAS * (aliased and rng.uniform() < 0.5)
        drawn.append(own_draws_of(y, error, aliased, rng))
    return drawn, nu, tau, np.flatnonzero(alone).tolist()


def found_of(drawn: Sequence[OwnDraws], problems: Sequence[InverseProblem], seed: int) -> CampaignPopulation:
    start = [draws.z for draws in drawn]
    return population_from(dict(enumerate(drawn)), {}, start, problems, NAMES, seed, HyperPrior(), Effort())


def synthetic(seed: int, key: str) -> Record:
    """Ranks of the truth among the draws, and who is named."""
    kind, bubbles, number = key.split("/")
    rng = np.random.default_rng([seed, KINDS.index(kind), int(bubbles), int(number)])
    drawn, nu, tau, odd = campaign(kind, int(bubbles), rng)
    began = time.process_time()
    result = found_of(drawn, [bubble(f"bubble{i}") for i in range(len(drawn))], int(number))
    quantiles = np.array([one.quantiles for one in result.empirical])
    return {
        "nu": np.mean(result.posterior.nu < nu, axis=0),
        "tau": np.mean(result.posterior.tau < tau, axis=0),
        "robust": (quantiles[:, 0] < nu) & (nu < quantiles[:, 2]),
        "odd": odd,
        "named": np.flatnonzero(1 - result.belongs > ODD),
        "size": result.estimate.size,
        "width": np.diff(np.quantile(result.posterior.nu[:, 0], [0.05, 0.95]))[0],
        "seconds": time.process_time() - began,
    }


def pairs(seed: int, key: str) -> Record:
    """Ranks of the difference of two medians and of that of the first, without and with the second known."""
    bubbles, number = map(int, key.split("/")[1:])
    rng = np.random.default_rng([seed, len(KINDS), bubbles, number])
    theta, nu = rng.standard_normal(), rng.standard_normal(2)
    apart = np.array([np.log(STIFFER) / LOG_STD, 0.0])
    problems, results = [bubble(f"bubble{i}") for i in range(bubbles)], []
    for gel in (nu, nu + apart):
        results.append(found_of(campaign("like", bubbles, rng, (theta, gel))[0], problems, number))
    error = KNOWN / LOG_STD
    known = [(0, nu[0] + apart[0] + error * rng.standard_normal(), error)]

    def centre(i: int, *told: tuple[int, float, float]) -> Centre:
        r = results[i]
        return without_pull(0, r.posterior.nu, r.theta, r.common, r.hyper.mean_std, r.estimate.size, number, told)

    both = drawn_together([centre(0), centre(1)], number)
    alone, told = drawn_together([centre(0)], number), drawn_together([centre(0), centre(1, *known)], number)
    other = drawn_together([centre(1)], number + 1)
    columns = {"difference": both[:, 1] - both[:, 0], "alone": alone[:, 0], "calibrated": told[:, 0]}
    truth = {"difference": apart[0], "alone": nu[0], "calibrated": nu[0]}
    return {
        **{name: np.mean(x < truth[name]) for name, x in columns.items()},
        **{f"{name} std": x.std() for name, x in columns.items()},
        "apart std": (other - alone).std(),
        "stiffer": np.mean(columns["difference"] > 0),
    }


def table_of_pairs(records: Sequence[Record], sizes: Sequence[int]) -> None:
    print(
        "| bubbles a gel | pairs | difference of ln G inside 90 % | its std (were nothing common) | stiffer with ",
        end="",
    )
    print("over 95 % | ln G of the first inside 90 % | std | calibrated inside 90 % | std |")
    print("|---|---|---|---|---|---|---|---|---|")
    for size in sizes:
        of_it = [r for r in records if r["key"].startswith(f"pair/{size}/")]
        inside, std = (
            {name: value([r[name + suffix] for r in of_it]) for name in ("difference", "alone", "calibrated")}
            for suffix, value in (("", lambda u: f"{100 * np.mean(np.abs(np.array(u) - 0.5) < 0.45):.0f} %"),
                                  (" std", lambda u: f"{LOG_STD * np.median(u):.2f}"))
        )  # fmt: skip
        nothing_common = f"{LOG_STD * np.median([r['apart std'] for r in of_it]):.2f}"
        cells = [
            size, len(of_it), inside["difference"], f"{std['difference']} ({nothing_common})",
            f"{100 * np.mean([r['stiffer'] > 0.95 for r in of_it]):.0f} %", inside["alone"], std["alone"],
            inside["calibrated"], std["calibrated"],
        ]  # fmt: skip
        print(f"| {' | '.join(map(str, cells))} |")


def table_of(records: Sequence[Record], kinds: Sequence[str], sizes: Sequence[int]) -> None:
    print("| campaigns | bubbles | number | ranks of the median, p | median inside 90 % | spread inside 90 % ", end="")
    print("| one by one, 90 % | fewer than 100 draws | the odd one named | others named | s |")
    print("|---|---|---|---|---|---|---|---|---|---|---|")
    for kind in kinds:
        for size in sizes:
            of_it = [r for r in records if r["key"].startswith(f"{kind}/{size}/")]
            if not of_it:
                continue
            nu, tau, robust = (
                np.array([r[key] for r in of_it], dtype=float).ravel() for key in ("nu", "tau", "robust")
            )
            odd = [i in r["named"] for r in of_it for i in r["odd"]]
            others = [bool(set(r["named"]) - set(r["odd"])) for r in of_it]
            cells = [
                kind, size, len(of_it), f"{min(kstest(nu[i::2], 'uniform').pvalue for i in (0, 1)):.3f}",
                *(f"{100 * np.mean(np.abs(u - 0.5) < 0.45):.0f} %" for u in (nu, tau)), f"{100 * robust.mean():.0f} %",
                sum(r["size"] < 100 for r in of_it), f"{100 * np.mean(odd):.0f} %" if odd else "–",
                f"{100 * np.mean(others):.0f} %", f"{np.median([r['seconds'] for r in of_it]):.1f}",
            ]  # fmt: skip
            print(f"| {' | '.join(map(str, cells))} |")


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
    parser.add_argument("what", choices=("synthetic", "pairs", "halves"))
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
    kinds = asked.kinds if asked.what == "synthetic" else ["pair"]
    keys = [f"{kind}/{size}/{i}" for i in range(asked.n) for kind in kinds for size in asked.bubbles]
    run, file = synthetic if asked.what == "synthetic" else pairs, f"{asked.what}_{asked.seed}.jsonl"
    records = list(fill(asked.records / file, keys, partial(run, asked.seed), asked.minutes).values())
    if asked.what == "synthetic":
        table_of(records, kinds, asked.bubbles)
    else:
        table_of_pairs(records, asked.bubbles)


if __name__ == "__main__":
    main()
