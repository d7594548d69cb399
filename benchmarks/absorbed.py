"""Could any discrepancy tell a wrong model from the truth, where the parameters take up what is wrong?

    python benchmarks/absorbed.py [--n 10] [--minutes 5]

For sets of ``misspecification.py`` whose discrepancy does not cover: χ² of the true parameters in the model of the fit,
and of the minimum of J that descents find with independent errors; and by how much the logarithm of the posterior
density is lower at the true parameters than at the mode of the fit with a discrepancy or at that minimum, each with
the amplitude and the length that suit it best (their prior counts). "As default" is the default prior and kernel. "Most
favourable" is the smallest difference that any of the documented forms gives: three kernels, of constant amplitude or
one that grows beyond 10 or 1 m/s, with a prior of the amplitude ten times as large in the median and twice as wide.
Medians over the sets, and the smallest. The highest density may lie elsewhere and be higher still: each difference is a
lower bound, which no sampler can change. The number of a set is its seed.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from misspecification import ROWS, with_discrepancy
from records import Record, fill
from scipy.optimize import minimize

from en4dvar.data.noise import SMOOTHNESS
from en4dvar.ensemble.forecast import forecast
from en4dvar.estimation.assimilate import assimilate
from en4dvar.model.state import Array
from en4dvar.problem import InverseProblem
from en4dvar.schemes.settings import AssimilationSettings

MISSED = (
    "laser, as stated",
    "laser, vapour and conducting medium",
    "laser, memory of 1 us by none",
    "laser, Fung by quadratic",
    "laser, radii 3 % too large",
)
DESCENTS = AssimilationSettings(what_if=False, refine="none", emulator="off")
LARGE = {"amplitude": {"median": "5 % of maximum", "log_std": 3.0}, "length": {"log_std": 1.4}}
GROWS = ({}, {"grows_beyond": "10 m/s"}, {"grows_beyond": "1 m/s"})
FORMS = [{**LARGE, **grows, "kernel": kernel} for kernel in SMOOTHNESS for grows in GROWS]
STARTS = ((-1.0, 0.0), (1.0, 0.0), (2.0, 1.0))  # of amplitude and length, prior standard deviations


def highest(problem: InverseProblem, parameters: Array) -> float:
    """The logarithm of the posterior density at some parameters (n,), with the discrepancy that suits them best."""
    prior, observed, n = problem.prior, problem.observations, len(parameters)
    run = forecast(problem, np.append(parameters, prior.mean[n:])[None]).predicted[0]

    def minus(z: Array) -> float:
        x = np.append(parameters, prior.mean[n:] + prior.std[n:] * z)
        predicted = replace(run, discrepancy=np.exp(x[n:]))
        cost = observed.noise.cost(observed.values, observed.weights, predicted)
        return float(cost) + 0.5 * float(np.sum(prior.white(x) ** 2))

    return -min(minimize(minus, start, method="Nelder-Mead").fun for start in STARTS)


def odds(key: str) -> Record:
    """χ² of truth and minimum, and the differences of the log density, of one set."""
    name, seed = key.rsplit("/", 1)
    twin = ROWS[name](int(seed))
    problem, truth = twin.problem, twin.truth
    plain = assimilate(problem, DESCENTS, int(seed))
    default = with_discrepancy(problem)
    fit = assimilate(default, DESCENTS, int(seed))
    modes = [problem.prior.from_physical(one.centre[None, : len(truth)])[0] for one in (plain, fit)]

    def lower(given: InverseProblem) -> float:
        return max(highest(given, mode) for mode in modes) - highest(given, truth)

    observed = problem.observations
    misses = observed.values - np.stack([forecast(problem, truth[None]).predictions[0], plain.centre_predictions])
    return {
        "chi2": np.sum((misses / observed.noise.std) ** 2, axis=1),
        "default": lower(default),
        "forms": [lower(with_discrepancy(problem, form)) for form in FORMS],
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--n", type=int, default=10, help="sets of each row")
    parser.add_argument("--minutes", type=float, default=np.inf, help="start no set after so long")
    parser.add_argument("--records", type=Path, default=Path("runs/absorbed"), help="folder of the records")
    options = parser.parse_args()
    keys = [f"{name}/{seed}" for seed in range(options.n) for name in MISSED]
    found = fill(options.records / "odds.jsonl", keys, odds, options.minutes)
    print("| what is wrong | sets | χ² of the truth | at the minimum | as default | least | most favourable | least |")
    print("|---|---|---|---|---|---|---|---|")
    for name in MISSED:
        good = [r for key, r in found.items() if key.rsplit("/", 1)[0] == name]
        if not good:
            continue
        chi2 = np.median([r["chi2"] for r in good], axis=0)
        cells = [str(len(good)), *(f"{value:.0f}" for value in chi2)]
        for values in ([r["default"] for r in good], [min(r["forms"]) for r in good]):
            cells += [f"{np.median(values):.1f}", f"{min(values):.1f}"]
        print(f"| {name} | {' | '.join(cells)} |")


if __name__ == "__main__":
    main()
