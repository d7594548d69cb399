"""Populations of bubbles whose single posteriors are exact: are medians and spreads held, and whom does it name as odd?

    python benchmarks/campaigns.py synthetic [--n 200] [--seed 1] [--bubbles 3 6 12 40] [--kinds …] [--spread 0.5]
    python benchmarks/campaigns.py pairs [--n 100] [--seed 1] [--bubbles 6 12]
    python benchmarks/campaigns.py power [--n 400] [--seed 1] [--bubbles 6 12 40] [--spread 0.5]

``synthetic``: campaigns of ``exact_campaigns.py``. ``normal``: mean, spread and odd bubbles as the hierarchy supposes.
``like``: bubbles that differ by a tenth of the prior, as of one gel. ``heavy``: the same by Student's t of three
degrees. ``gel``, ``scale``, ``law``: ``like`` with one bubble of four times the modulus, of radii 8 % too large, of a
gel that stiffens. Beside those named stands the best test there is: the odds of each bubble with median, spread and
common quantities known, and a bound that 5 % of the ``like`` campaigns exceed. ``--spread``: of the hyperprior;
``init`` writes 0.25 for gels.

``pairs``: two gels, the second 30 % stiffer, whose readings are shifted by the same scale, density and pressure: is the
difference held, how often is it seen, what does the first gain where the second is known to 4 %, beside the closed form
of a linear hierarchy of known spread, and what is held where these three are taken to be right?

``power``: what can be seen at all? The hierarchy of G alone, what is common included in its median, by quadrature over
median and spread, without draws: the share of odd bubbles that are named, and that would be by the best test, where the
spread is unknown and where it is known, of errors as above and of 6 to 16 %. The best test is the ratio of the odds
with a bound that 5 % of clean campaigns of two such parameters exceed.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
from exact_campaigns import ALIAS, COMMON, ERRORS, KINDS, LIKE, LOG_STD, SHIFTS, SLOPES, campaign, found_of
from records import Record, fill
from scipy.stats import kstest, norm

from en4dvar.estimation.population import HyperPrior
from en4dvar.estimation.population.contrast import Centre, drawn_together, without_pull
from en4dvar.estimation.population.hierarchy import A_SET, RAISED, named
from en4dvar.model.state import Array

STIFFER, KNOWN = 1.3, 0.04  # of the second gel of a pair; how well its modulus is known


def synthetic(seed: int, hyper: HyperPrior, key: str) -> Record:
    """Ranks of the truth among the draws, and who is named."""
    kind, bubbles, number = key.split("/")
    rng = np.random.default_rng([seed, KINDS.index(kind), int(bubbles), int(number)])
    of_it = campaign(kind, int(bubbles), rng)
    began = time.process_time()
    result = found_of(of_it.drawn(rng), int(number), hyper=hyper)
    quantiles = np.array([one.quantiles for one in result.empirical])
    return {
        "nu": np.mean(result.posterior.nu < of_it.nu, axis=0),
        "tau": np.mean(result.posterior.tau < of_it.tau, axis=0),
        "robust": (quantiles[:, 0] < of_it.nu) & (of_it.nu < quantiles[:, 2]),
        "odd": of_it.odd,
        "chances": 1 - result.belongs,
        "odds": of_it.odds(),
        "size": result.size,
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
        return without_pull(0, r.posterior.nu, r.theta, r.common, r.hyper.mean_std, r.size, number, told)

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


def raised(
    bubbles: int, kind: str, count: int, errors: tuple[float, float], tau: Array, seed: int, hyper: HyperPrior
) -> Array:
    """(count, S) by what factor the readings of G raise the odds of each bubble in as many campaigns; τ is one of
    ``tau`` (T,), the first bubble of a ``kind``.
    """
    rng, slots = np.random.default_rng([seed, bubbles]), (..., None, None)
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


def power(seed: int, sizes: Sequence[int], count: int, hyper: HyperPrior) -> None:
    print("| errors of G | bubbles | the first | named | by the best test | spread known | others named |")
    print("|---|---|---|---|---|---|---|")
    unknown, known = np.geomspace(0.02, 2.0, 21), np.array([LIKE])
    for errors in (ERRORS, (0.03, 0.08)):
        for size in sizes:
            clean = [raised(size, "like", count, errors, tau, seed, hyper).max(axis=1) for tau in (unknown, known)]
            bounds = [np.quantile(highest, 0.975) for highest in clean]
            limit = max(RAISED, A_SET * size)
            false = 1 - np.mean(clean[0] < limit) ** 2  # of G or of μ
            for kind in SHIFTS:
                first = [raised(size, kind, count, errors, tau, seed + 1, hyper)[:, 0] for tau in (unknown, known)]
                shares = [_share(of.tolist()) for of in (first[0] > limit, first[0] > bounds[0], first[1] > bounds[1])]
                about = f"{100 * LOG_STD * errors[0]:.0f} to {100 * LOG_STD * errors[1]:.0f} %"
                print(f"| {about} | {size} | {kind} | {' | '.join(shares)} | {100 * false:.0f} % |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("synthetic", "pairs", "power"))
    parser.add_argument("--n", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--bubbles", type=int, nargs="+", default=[3, 6, 12, 40])
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=KINDS)
    parser.add_argument("--spread", type=float, default=HyperPrior().spread, help="of the hyperprior")
    parser.add_argument("--minutes", type=float, default=9.0)
    parser.add_argument("--records", type=Path, default=Path("runs/campaigns"), help="folder of the records")
    asked = parser.parse_args()
    hyper = HyperPrior(spread=asked.spread)
    if asked.what == "power":
        power(asked.seed, asked.bubbles, asked.n, hyper)
        return
    file = asked.records / f"{asked.what}_{asked.seed}_{asked.spread:g}.jsonl"
    kinds = asked.kinds if asked.what == "synthetic" else ["pair"]
    keys = [f"{kind}/{size}/{i}" for i in range(asked.n) for kind in kinds for size in asked.bubbles]
    of_it = partial(synthetic, asked.seed, hyper) if asked.what == "synthetic" else partial(pairs, asked.seed)
    records = list(fill(file, keys, of_it, asked.minutes).values())
    if asked.what == "synthetic":
        table_of(records, kinds, asked.bubbles)
    else:
        table_of_pairs(records, asked.bubbles)


if __name__ == "__main__":
    main()
