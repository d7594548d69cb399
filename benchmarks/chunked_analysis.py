"""One analysis of a large state: time and memory against the least that any ensemble analysis needs.

    python benchmarks/chunked_analysis.py [--size 1000000] [--members 48]

Time: relative to one product of an (n × N) with an (N × N) matrix, one thread, best of three. Memory: the peak of
everything allocated during the analysis, the ensemble included, relative to the ensemble.
"""

from __future__ import annotations

import os

os.environ.update(OPENBLAS_NUM_THREADS="1", MKL_NUM_THREADS="1")

import argparse
import time
import tracemalloc
from collections.abc import Callable

import numpy as np

from en4dvar.ensemble.linalg import apply_weights
from en4dvar.schemes.base import Evaluation, Runs, Weights, gauss_newton
from en4dvar.schemes.filters import ETKF


def best(task: Callable[[], object], repeats: int = 3) -> float:
    """Seconds of the fastest of ``repeats``."""
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        task()
        times.append(time.perf_counter() - began)
    return min(times)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", type=int, default=1_000_000)
    parser.add_argument("--members", type=int, default=48)
    arguments = parser.parse_args()
    n, n_members = arguments.size, arguments.members
    rng = np.random.default_rng(0)
    seen = np.arange(0, n, n // 200)
    y, scheme = rng.standard_normal(len(seen)), ETKF()

    tracemalloc.start()
    ensemble = rng.standard_normal((n_members, n))

    def analyse() -> np.ndarray:
        weights = Weights.prior(n_members)
        reference, spread = scheme.linearise(weights, Runs(ensemble[:, seen]))
        step = gauss_newton(weights.w, Evaluation(y - reference, spread.T))
        return apply_weights(ensemble, step.weights.rows)

    tracemalloc.reset_peak()
    analyse()
    peak = tracemalloc.get_traced_memory()[1] / ensemble.nbytes
    tracemalloc.stop()

    square = rng.standard_normal((n_members, n_members))
    columns = np.asfortranarray(ensemble.T)  # n × N, members contiguous as they are stored
    product = min(best(lambda: columns @ square), best(lambda: square @ ensemble))  # the better layout
    seconds = best(analyse)
    print(f"n = {n}, N = {n_members}: one (n × N)(N × N) product {product:.3f} s")
    print(f"analysis {seconds:.3f} s   {seconds / product:.2f} × the product   peak {peak:.2f} × the ensemble")


if __name__ == "__main__":
    main()
