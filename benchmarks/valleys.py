"""Are populations as wide as they should be where each data set leaves a valley of two parameters open?

    python benchmarks/valleys.py [--n 6] [--start 0] [--sets 6] [--spread 0.03] [--minutes 14]

Each data set reads (2a + 1.4b + bend, 1.4b) of its a and b with errors of 0.1 and 3, priors are N(0, 1), the truth lies
at (0.9, −1.1). The bend is none (straight), 0.3 t² (bent) or that of a knee, t = a − 0.7b; of what is common, θ, which
is N(0, 1), nothing, as much along the valley (shifts), or the more the farther along (turns) is taken from a. The exact
posterior of the medians is a sum over a grid of spacing 0.015, smoothed by the spreads in Fourier space, and over
nodes of θ and of the spreads. Records stand in runs/valleys and are continued.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
from records import Record, fill
from scipy.fft import fftfreq, irfft2, rfft2, rfftfreq

from en4dvar.data.noise import noise_of
from en4dvar.data.observations import Observations
from en4dvar.estimation.population import HyperPrior, population_of
from en4dvar.model.function_model import FunctionModel
from en4dvar.model.state import Array, Parameter
from en4dvar.priors.prior import Prior, PriorTerm
from en4dvar.problem import InverseProblem

RECORDS, ERRORS, TRUTH = Path("runs") / "valleys", np.array([0.1, 3.0]), (0.9, -1.1)
STEP, COUNT, TAUS = 0.015, 768, 3
AXIS = STEP * (np.arange(COUNT) - COUNT // 2)
A, B = np.meshgrid(AXIS, AXIS, indexing="ij")
WAVES = 2 * np.pi * fftfreq(COUNT, STEP)[:, None], 2 * np.pi * rfftfreq(COUNT, STEP)
KINDS = [f"{shape} {common}" for common in ("nothing", "shifts", "turns") for shape in ("straight", "bent", "knee")]


def read(kind: str, a: Array | float, b: Array | float, theta: Array | float = 0.0) -> tuple[Array, Array]:
    shape, common = kind.split()
    if common != "nothing":
        turns = 0.125 * (a - 0.7 * b) if common == "turns" else 0.0
        a, b = a - (0.3 + turns) * theta, b + 0.2 * theta
    t = a - 0.7 * b
    bend = {"straight": 0.0 * t, "bent": 0.3 * t**2, "knee": 0.8 * np.sqrt(t**2 + 0.01)}[shape]
    return np.asarray(2 * a + 1.4 * b + bend), np.asarray(1.4 * b)


def likelihood(kind: str, values: Array, theta: float) -> Array:
    """On the grid."""
    return np.exp(-0.5 * np.sum(((values - np.stack(read(kind, A, B, theta), axis=-1)) / ERRORS) ** 2, axis=-1))


def nodes(kind: str) -> tuple[Array, Array]:
    """Of θ, with their weights."""
    theta, weights = np.polynomial.hermite_e.hermegauss(1 if "nothing" in kind else 7)
    return theta, weights / weights.sum()


def exact(kind: str, values: Array, spread: float) -> tuple[Array, Array]:
    """Means and standard deviations (2,) of the medians of a and b."""
    t, of_t = np.polynomial.legendre.leggauss(TAUS)
    taus, of_t = 1.75 * spread * (t + 1), of_t * np.exp(-0.5 * (1.75 * (t + 1)) ** 2)
    total, top = np.zeros((COUNT, COUNT)), None
    for theta, weight in zip(*nodes(kind), strict=True):
        waves = [rfft2(likelihood(kind, y, theta)) for y in values]
        for i in range(TAUS):
            for j in range(TAUS):
                smoothing = np.exp(-0.5 * ((WAVES[0] * taus[i]) ** 2 + (WAVES[1] * taus[j]) ** 2))
                each = (np.log(np.maximum(irfft2(w * smoothing, s=A.shape), 1e-40)) for w in waves)
                logs = -0.5 * (A**2 + B**2) + sum(each)
                top = logs.max() if top is None else top
                total += weight * of_t[i] * of_t[j] * np.exp(logs - top)
    shares = np.stack([total.sum(axis=1), total.sum(axis=0)]) / total.sum()
    mean = shares @ AXIS
    return mean, np.sqrt(shares @ AXIS**2 - mean**2)


def problems(kind: str, values: Array) -> list[InverseProblem]:
    names = ["a", "b"] if "nothing" in kind else ["a", "b", "theta"]

    def function(p: dict[str, Array], t: Array) -> Array:
        first, second = read(kind, *(p[name] for name in names))
        return np.where(t < 0.5, first, second)

    parameters = [Parameter(name, "1", common=name == "theta") for name in names]
    model = FunctionModel(function, parameters, {"y": "1"}, members=400, cheap=True)
    prior = Prior(tuple(PriorTerm.normal(p, 0.0, 1.0) for p in model.parameters))
    times, of_y = np.array([0.2, 1.0]), noise_of(ERRORS, np.zeros(2))
    observed = [Observations(times, y, of_y, np.ones(2), name=f"set{s}") for s, y in enumerate(values)]
    return [InverseProblem(model, model.observables[0], o, prior) for o in observed]


def ratios(kind: str, seed: int, sets: int, spread: float) -> Record:
    rng = np.random.default_rng([20265, seed, sets])
    values = np.stack(read(kind, *TRUTH)) + ERRORS * rng.standard_normal((sets, 2))
    mean, std = exact(kind, values, spread)
    start = []
    for y in values:  # as members of an ensemble
        posterior = likelihood(kind, y, 0.0) * np.exp(-0.5 * (A**2 + B**2))
        at = np.unravel_index(rng.choice(A.size, 48, p=posterior.ravel() / posterior.sum()), A.shape)
        members = np.stack([AXIS[k] for k in at], axis=1)
        start.append(members if "nothing" in kind else np.hstack([members, 0.3 * rng.standard_normal((48, 1))]))
    began = time.process_time()
    hyper = HyperPrior(1.0, spread, odd=0.0)
    result = population_of(problems(kind, values), start, ["a", "b"], seed, hyper=hyper)
    nu = result.posterior.nu
    return {"width": nu.std(axis=0) / std, "off": (nu.mean(axis=0) - mean) / std, "runs": result.forward_runs,
            "size": result.size, "seconds": time.process_time() - began}  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--n", type=int, default=6)
    parser.add_argument("--start", type=int, default=0)
    parser.add_argument("--sets", type=int, default=6)
    parser.add_argument("--spread", type=float, default=0.03)
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=KINDS)
    parser.add_argument("--minutes", type=float, default=14.0)
    asked = parser.parse_args()
    keys = [f"{kind}:{seed}" for seed in range(asked.start, asked.start + asked.n) for kind in asked.kinds]

    def of_key(key: str) -> Record:
        kind, seed = key.split(":")
        return ratios(kind, int(seed), asked.sets, asked.spread)

    done = fill(RECORDS / f"{asked.sets}_{asked.spread}.jsonl", keys, of_key, asked.minutes)
    print("| valley, what is common | campaigns | width of a, b | of all, ± | off by | forward runs | seconds |")
    print("|---|---|---|---|---|---|---|")
    for kind in asked.kinds:
        records = [record for key, record in done.items() if key.startswith(f"{kind}:")]
        if records:
            width, off = (np.array([record[name] for record in records]) for name in ("width", "off"))
            runs, seconds = (np.mean([record[name] for record in records]) for name in ("runs", "seconds"))
            a, b = width.mean(axis=0)
            error = width.mean(axis=1).std() / np.sqrt(max(len(records) - 1, 1))
            words = f"| {kind} | {len(records)} | {a:.2f}, {b:.2f} | ± {error:.2f} | "
            print(words + ", ".join(f"{value:+.2f}" for value in off.mean(axis=0)) + f" | {runs:.0f} | {seconds:.1f} |")


if __name__ == "__main__":
    main()
