"""Expected information of planned bubbles: is it right, is it kept, and how fast is it told?

    python benchmarks/design.py speed             100 designs by linearisation over the prior: seconds of one core
    python benchmarks/design.py exact laser       20 random designs, linearised and nested, against brute force
    python benchmarks/design.py promise laser     experiments at the designed and at the customary readings, estimated
    python benchmarks/design.py frames laser      half the frames, chosen, against all at a fixed rate

``laser`` (neo-Hookean Kelvin-Voigt, priors of benchmarks/laser_twin.py) or ``acoustic`` (quadratic law, narrow priors
of benchmarks/acoustic_twin.py). Design ``i`` of ``exact`` has seed ``i``: step and end of the readings, their error
and, of a laser bubble, the largest radius. Brute force takes ln p(y) of each of 2000 simulated sets of readings from
10⁵ draws of the prior, none of which a set came from; errors are four times as large as a
camera's, so that enough draws explain a set: fewest and median effective numbers of them are told. All are synthetic.
Records are kept and the next call goes on (``--minutes``).
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import acoustic_twin
import laser_twin
import numpy as np
from records import Record, fill
from scipy.special import logsumexp
from scipy.stats import kendalltau

from en4dvar.data.noise import noise_of
from en4dvar.data.observations import Observations
from en4dvar.estimation.assimilate import assimilate
from en4dvar.estimation.design.evaluate import SampleSizes, choose, evaluate
from en4dvar.estimation.design.planned import Planned
from en4dvar.model.state import Array
from en4dvar.plumbing.errors import En4dvarError
from en4dvar.priors.prior import Prior
from en4dvar.problem import InverseProblem
from en4dvar.schemes.settings import AssimilationSettings
from en4dvar_bubble import BubbleModel

ABOUT = ("G", "mu")
SIZES = SampleSizes()
MORE = SampleSizes(simulated=400, inner=400)
FINE = SampleSizes(draws=800, simulated=800, inner=400)  # errors of 0.03 nats
COARSE, INNER, OUTER = 4.0, 100_000, 2000
# first and last instant, spacing of candidates, least distance of two that are chosen, s; error, m; frames
CAMERA = {
    "laser": (0.7e-6, 60e-6, 0.2e-6, 1e-6, 1.5e-6, 16),
    "acoustic": (5.6e-6, 25e-6, 0.2e-6, 1e-6, 1.4e-6, 14),
}
# a fixed rate that ends with its frames, and until when half as many may be chosen: s
RATE = {"laser": (laser_twin.TIMES, 60e-6), "acoustic": (5.6e-6 + 1.5e-6 * np.arange(14), 40e-6)}


def planned(kind: str, times: Array, std: float, largest: float = laser_twin.LARGEST) -> InverseProblem:
    """An experiment with readings at ``times`` (K,)."""
    model: BubbleModel = laser_twin.MODEL if kind == "laser" else acoustic_twin.MODEL
    prior = laser_twin.laser_prior() if kind == "laser" else acoustic_twin.prior()
    terms = [replace(t, mean=largest) if t.parameter.name == "R_max" else t for t in prior.terms]
    ones = np.ones(len(times))
    data = Observations(times, ones, noise_of(std * ones, 0 * ones), ones, name=kind)
    return InverseProblem(model, model.observables[0], data, Prior(tuple(terms)))


def random_design(kind: str, seed: int, coarse: float = 1.0) -> InverseProblem:
    """Design ``seed``; errors ``coarse`` times as large."""
    rng, (first, last, *_) = np.random.default_rng([20261122, seed]), CAMERA[kind]
    step, end = rng.uniform(0.7e-6, 3e-6), rng.uniform(first + 0.4 * (last - first), last)
    std = coarse * rng.uniform(0.5e-6, 3e-6)
    return planned(kind, np.arange(first, end, step), std, rng.uniform(180e-6, 280e-6))


def speed(count: int) -> None:
    """Seconds of so many designs."""
    evaluate(random_design("laser", 0), ABOUT, SIZES, "laplace", 0)  # compiles
    began, cpu = time.perf_counter(), time.process_time()
    runs = sum(evaluate(random_design("laser", i), ABOUT, SIZES, "laplace", 0)[0].forward_runs for i in range(count))
    print(
        f"{count} designs, {runs} runs: {time.process_time() - cpu:.1f} s of CPU, {time.perf_counter() - began:.1f} s"
    )


def exact(kind: str, seed: int) -> Record:
    """Information about everything: linearised, nested, and by brute force, with standard errors."""
    problem = random_design(kind, seed, COARSE)
    cheap, nested = (evaluate(problem, (), FINE, method, seed)[0] for method in ("laplace", "nested"))
    whole, std, rng = Planned(problem), problem.observations.std, np.random.default_rng([7, seed])
    others, truths = (_predictions(whole, count, k, seed) / std for count, k in ((INNER, 11), (OUTER, 12)))
    gains, effective = [], []
    for part in np.array_split(truths, 200):
        e = rng.standard_normal(part.shape)
        y = part + e
        logs = y @ others.T - 0.5 * np.sum(others**2, axis=1)
        shares = np.exp(logs - logsumexp(logs, axis=1, keepdims=True))
        effective += list(1 / np.sum(shares**2, axis=1))
        evidence = logsumexp(logs, axis=1) - np.log(len(others)) - 0.5 * np.sum(y**2, axis=1)
        gains += list(-0.5 * np.sum(e**2, axis=1) - evidence)
    brute = float(np.mean(np.array(gains) - 0.5 * (1 / np.array(effective) - 1 / len(others))))
    return {
        "readings": len(std),
        "laplace": (cheap.gain, cheap.error),
        "nested": (nested.gain, nested.error),
        "brute": (brute, float(np.std(gains) / np.sqrt(len(gains)))),
        "effective": (float(np.min(effective)), float(np.median(effective))),
    }


def _predictions(whole: Planned, count: int, *seed: int) -> Array:
    rng = np.random.default_rng(seed)
    found = whole.run(rng.standard_normal((count, len(whole.names)))).predictions
    return np.asarray(found[np.isfinite(found).all(axis=1)])


def tell_exact(records: Mapping[str, Record]) -> None:
    """Differences from brute force and Kendall's tau."""
    for key, r in records.items():
        (cheap, _), (nested, error), (brute, its) = r["laplace"], r["nested"], r["brute"]
        print(
            f"design {key}: {r['readings']} readings, linearised {cheap:.3f}, nested {nested:.3f} ± {error:.3f}, brute "
            f"force {brute:.3f} ± {its:.3f}, behind it {r['effective'][0]:.0f}, {r['effective'][1]:.0f} draws"
        )
    brute, its = np.array([r["brute"] for r in records.values()]).T
    for name in ("laplace", "nested"):
        found, error = np.array([r[name] for r in records.values()]).T
        off, i, j = np.abs(found - brute), *np.triu_indices(len(brute), 1)
        told = np.abs(brute[i] - brute[j]) > 2 * np.hypot(np.hypot(its[i], its[j]), np.hypot(error[i], error[j]))
        same = np.sign(found[i] - found[j]) == np.sign(brute[i] - brute[j])
        print(
            f"{name}: {off.max():.3f} nats off at most, {np.mean(found - brute):+.3f} in the mean; Kendall's tau "
            f"{kendalltau(found, brute).statistic:.3f}, of the {told.sum()} of {len(told)} pairs that errors tell "
            f"apart {2 * same[told].mean() - 1:.3f}"
        )


def chosen(kind: str, count: int, last: float) -> InverseProblem:
    """So many readings until ``last`` (s) that tell most about G and mu."""
    first, _, fine, apart, std, _ = CAMERA[kind]
    times = np.arange(first, last, fine)
    whole = Planned(planned(kind, times, std), ABOUT)
    return planned(kind, times[choose(whole, whole.draws(SIZES.draws, 1), count, apart)], std)


def settings_of(kind: str) -> dict[str, InverseProblem]:
    """The customary readings, at a fixed rate, and as many that are chosen in the same window."""
    first, last, _, _, std, count = CAMERA[kind]
    return {"customary": planned(kind, np.linspace(first, last, count), std), "designed": chosen(kind, count, last)}


def frames(kind: str) -> None:
    """All readings at a fixed rate against half as many that are chosen, in a longer window and in the same one."""
    (rate, longest), (_, last, *_, std, count) = RATE[kind], CAMERA[kind]
    compared = {
        "rate of the twin": planned(kind, rate, std),
        "half, until later": chosen(kind, len(rate) // 2, longest),
        "customary": settings_of(kind)["customary"],
        "half, same window": chosen(kind, count // 2, last),
    }
    for name, problem in compared.items():
        cheap, nested = (evaluate(problem, ABOUT, MORE, method, 0)[0] for method in ("laplace", "nested"))
        print(
            f"{kind}, {name}: {len(problem.observations)} readings, linearised {cheap.gain:.3f} ± {cheap.error:.3f}, "
            f"nested {nested.gain:.3f} ± {nested.error:.3f} nats; µs {np.round(1e6 * problem.observations.times, 1)}",
            flush=True,
        )


def promise(problem: InverseProblem, seed: int) -> Record:
    """Realised gain about G and mu of experiment ``seed``: posterior from prior, as Gaussians of transformed space."""
    prior, rng = problem.prior, np.random.default_rng([23, seed])
    while True:
        truth = prior.mean + prior.std * rng.standard_normal(len(prior.names))
        run = Planned(problem).composite(truth[None])
        if not run.failures[0]:
            break
    values = run.predictions[0] + problem.observations.std * rng.standard_normal(len(problem.observations))
    observed = replace(problem.observations, values=values)
    try:
        analysis = assimilate(replace(problem, observations=observed), AssimilationSettings(what_if=False), seed)
    except En4dvarError as error:
        return {"failure": str(error)}
    which = [prior.names.index(name) for name in ABOUT]
    z = (prior.from_physical(analysis.survivors) - prior.mean)[:, which] / prior.std[which]
    covariance, mean = np.cov(z, rowvar=False), z.mean(axis=0)
    log_det = float(np.linalg.slogdet(covariance)[1])
    return {
        "gain": 0.5 * (np.trace(covariance) + mean @ mean - len(which) - log_det),
        "warned": [c.code for c in analysis.cautions if c.severity != "note"],
    }


def tell_promise(predicted: tuple[float, float], records: Mapping[str, Record]) -> None:
    """Mean of what was realised beside what was predicted."""
    gains = np.array([r["gain"] for r in records.values() if "gain" in r])
    mean, error = gains.mean(), gains.std(ddof=1) / np.sqrt(len(gains))
    apart = (mean - predicted[0]) / np.hypot(error, predicted[1])
    warned = sum(bool(r.get("warned")) for r in records.values())
    print(
        f"{len(records)} experiments, {len(records) - len(gains)} failed, {warned} warned: realised {mean:.3f} ± "
        f"{error:.3f}, predicted {predicted[0]:.3f} ± {predicted[1]:.3f}, {apart:+.1f} standard errors apart"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("speed", "exact", "promise", "frames"))
    parser.add_argument("kind", nargs="?", choices=tuple(CAMERA), default="laser")
    parser.add_argument("--n", type=int, help="designs or experiments; default 100, 20 or 200")
    parser.add_argument("--minutes", type=float, default=1e9, help="stop after so many and tell what there is")
    parser.add_argument("--records", type=Path, default=Path("runs/design"))
    given = parser.parse_args()
    kind, folder = given.kind, given.records
    if given.what == "speed":
        speed(given.n or 100)
    elif given.what == "frames":
        frames(kind)
    elif given.what == "exact":
        keys = map(str, range(given.n or 20))
        tell_exact(fill(folder / f"exact_{kind}.jsonl", keys, lambda key: exact(kind, int(key)), given.minutes))
    else:
        settings = settings_of(kind)
        keys = [f"{i} {name}" for i in range(given.n or 200) for name in ("customary", "designed")]

        def one(key: str) -> Record:
            number, name = key.split()
            return promise(settings[name], int(number))

        found = fill(folder / f"promise_{kind}.jsonl", keys, one, given.minutes)
        for name in ("customary", "designed"):
            print(f"{kind}, {name}: ", end="")
            worth = evaluate(settings[name], ABOUT, MORE, "nested", 0)[0]
            tell_promise((worth.gain, worth.error), {k: r for k, r in found.items() if k.endswith(name)})
        pairs = [
            [found.get(f"{i} {name}", {}).get("gain") for name in ("designed", "customary")] for i in range(len(found))
        ]
        more = np.array([a - b for a, b in pairs if a is not None and b is not None])
        error = more.std(ddof=1) / np.sqrt(len(more))
        print(f"designed over customary, of the same truths: {more.mean():+.3f} ± {error:.3f} ({len(more)} pairs)")


if __name__ == "__main__":
    main()
