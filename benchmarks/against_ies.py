"""ES-MDA side by side with ``iterative_ensemble_smoother`` on a linear problem: same posterior, analysis time.

    pip install '.[benchmark]'
    python benchmarks/against_ies.py

Both get the same ensemble, and first the same perturbations, so that the posteriors agree to rounding; then each draws
its own, and both are compared with the exact posterior. Times are of the analysis alone, one thread.
"""

from __future__ import annotations

import os

os.environ.update(OPENBLAS_NUM_THREADS="1", MKL_NUM_THREADS="1")

import time
from collections.abc import Callable

import numpy as np

from en4dvar.descent.field import field_esmda
from en4dvar.descent.field_data import FieldData
from en4dvar.ensemble.linalg import centre
from en4dvar.schemes.base import Evaluation, Weights
from en4dvar.schemes.esmda import ESMDA
from en4dvar.schemes.local_gain import ByCorrelation, ByDistance

COEFFICIENTS = (9.333, 7.0, 4.0, 2.0)
Draw = Callable[[int], np.ndarray]


def ours(x: np.ndarray, g: np.ndarray, y: np.ndarray, std: np.ndarray, draw: Draw) -> tuple[np.ndarray, float]:
    """Posterior (N, n) of members (N, n) and the seconds of the analyses; ``draw(a)`` gives z (N, K)."""
    scheme, spent = ESMDA(COEFFICIENTS), 0.0
    mean, anomalies = centre(x)
    weights = Weights.prior(len(x))
    members = x
    for a in range(scheme.passes):
        predictions, noise = members @ g.T, draw(a)
        began = time.perf_counter()
        reference, spread = centre(predictions)
        evaluation = Evaluation((y - reference) / std, (spread / std).T)
        weights = scheme.advance(weights, evaluation, a, lambda _, noise=noise: noise).weights
        members = mean + weights.rows @ anomalies
        spent += time.perf_counter() - began
    return members, spent


def theirs(x: np.ndarray, g: np.ndarray, y: np.ndarray, std: np.ndarray, draw: Draw) -> tuple[np.ndarray, float]:
    """The same by iterative_ensemble_smoother, nothing truncated."""
    from iterative_ensemble_smoother import ESMDA as Smoother

    smoother, spent = Smoother(std**2, y, np.array(COEFFICIENTS), seed=0), 0.0
    members = np.ascontiguousarray(x.T)
    for a in range(len(COEFFICIENTS)):
        predictions, noise = g @ members, draw(a)
        noise = std[:, None] * (noise - noise.mean(axis=0)).T
        began = time.perf_counter()
        smoother.prepare_assimilation(Y=predictions, truncation=1.0, observation_perturbations=noise)
        members = smoother.assimilate_batch(X=members)
        spent += time.perf_counter() - began
    return members.T, spent


def adaptive(n: int) -> None:
    """ES-MDA of n parameters localised by correlation, both with the threshold 3/√N and the same perturbations."""
    from iterative_ensemble_smoother import AdaptiveESMDA

    rng, (k, n_members) = np.random.default_rng(1), (200, 100)
    x, of = rng.standard_normal((n_members, n)), rng.permutation(n)[:k]
    std, y = rng.uniform(0.5, 1.0, k), rng.standard_normal(k)
    alphas = ESMDA(COEFFICIENTS).inflations
    smoother = AdaptiveESMDA(std**2, y, np.array(COEFFICIENTS), seed=0)
    a, b = x.copy(), np.ascontiguousarray(x.T)
    spent = {"ours": 0.0, "theirs": 0.0}
    for alpha in alphas:
        noise = rng.standard_normal((n_members, k))
        noise = std * (noise - noise.mean(axis=0))
        began = time.perf_counter()
        predictions = a[:, of]
        update = ByCorrelation().update(
            predictions - predictions.mean(axis=0), alpha * std**2, y + np.sqrt(alpha) * noise - predictions
        )
        a += update(slice(0, n), a - a.mean(axis=0))
        spent["ours"] += time.perf_counter() - began
        began = time.perf_counter()
        smoother.prepare_assimilation(Y=b[of], truncation=1.0, observation_perturbations=noise.T)
        b = smoother.assimilate_batch(X=b, n_jobs=1)
        spent["theirs"] += time.perf_counter() - began
    print(
        f"adaptive localisation, n = {n}, K = {k}, N = {n_members}: largest difference {np.max(np.abs(a - b.T)):.1e}; "
        f"spread {np.sqrt(np.mean(a.var(axis=0, ddof=1))):.3f}; {1e3 * spent['ours']:.0f} ms, theirs "
        f"{1e3 * spent['theirs']:.0f} ms"
    )


def by_distance() -> None:
    """ES-MDA localised by distance on 2000 correlated parameters, against the exact posterior.

    Theirs tapers the gain, ours the covariances that it is made of, so that the two are not the same numbers.
    """
    from iterative_ensemble_smoother import LocalizedESMDA

    rng, (n, n_members), radius = np.random.default_rng(0), (2000, 100), 12.0
    places = np.arange(float(n))[:, None]
    read = np.arange(5, n, 10)
    std, k = np.full(len(read), 0.5), len(read)
    P = np.exp(-0.5 * (np.subtract.outer(places[:, 0], places[:, 0]) / 5) ** 2) + 1e-8 * np.eye(n)
    root = np.linalg.cholesky(P)
    x = rng.standard_normal((n_members, n)) @ root.T
    y = (root @ rng.standard_normal(n))[read] + std * rng.standard_normal(k)
    gain = P[:, read] @ np.linalg.inv(P[np.ix_(read, read)] + np.diag(std**2))
    mean, spread = gain @ y, np.sqrt(np.mean(np.diag(P) - np.sum(gain * P[:, read], axis=1)))
    near, smoother = ByDistance(places, places[read], radius), LocalizedESMDA(std**2, y, np.array(COEFFICIENTS), seed=0)
    a, b = x.copy(), np.ascontiguousarray(x.T)
    field_esmda(a, FieldData(y, std, lambda members: members[:, read]), near, COEFFICIENTS)
    taper = near.taper(slice(0, n))
    for _ in COEFFICIENTS:
        smoother.prepare_assimilation(Y=b[read], truncation=1.0)
        b = smoother.assimilate_batch(X=b, localization_callback=lambda K: taper * K)
    for name, members in (("prior", x), ("ours", a), ("theirs", b.T)):
        off = np.sqrt(np.mean((members.mean(axis=0) - mean) ** 2)) / spread
        own = np.sqrt(np.mean(members.var(axis=0, ddof=1))) / spread
        print(
            f"by distance, n = {n}, K = {k}, N = {n_members}: {name}: mean off by {off:.2f}, spread {own:.2f} exact std"
        )


def main() -> None:
    adaptive(2000)
    adaptive(100_000)
    by_distance()
    for n, k, n_members in ((20, 200, 100), (2000, 100, 100), (20_000, 500, 100), (2000, 500, 1000)):
        rng = np.random.default_rng(0)
        g = rng.standard_normal((k, n)) / np.sqrt(n)
        std = rng.uniform(0.5, 1.0, k)
        x = rng.standard_normal((n_members, n))
        y = g @ rng.standard_normal(n) + std * rng.standard_normal(k)
        draws = [rng.standard_normal((n_members, k)) for _ in COEFFICIENTS]
        times = {"ours": np.inf, "theirs": np.inf}
        for _ in range(3):
            a, took = ours(x, g, y, std, draws.__getitem__)
            times["ours"] = min(times["ours"], took)
            b, took = theirs(x, g, y, std, draws.__getitem__)
            times["theirs"] = min(times["theirs"], took)
        # the exact posterior of the ensemble's own moments, along the predictions
        mean, anomalies = centre(x)
        spread = anomalies @ g.T / np.sqrt(n_members - 1)
        gain = np.linalg.solve(spread.T @ spread + np.diag(std**2), y - g @ mean)
        exact = mean + anomalies.T @ (spread @ gain) / np.sqrt(n_members - 1)
        other = ours(x, g, y, std, lambda _, rng=rng, shape=draws[0].shape: rng.standard_normal(shape))[0]
        sampling = [np.linalg.norm(e.mean(axis=0) - exact) / np.linalg.norm(exact - mean) for e in (other, b)]
        print(
            f"n = {n:6d}, K = {k:4d}, N = {n_members:5d}: largest difference {np.max(np.abs(a - b)):.1e}; mean off the "
            f"exact one by {sampling[0]:.3f} (ours), {sampling[1]:.3f} (theirs) of the increment; analysis "
            f"{1e3 * times['ours']:.1f} ms, theirs {1e3 * times['theirs']:.1f} ms, "
            f"ratio {times['theirs'] / times['ours']:.2f}"
        )


if __name__ == "__main__":
    main()
