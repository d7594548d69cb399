"""Localised ES-MDA and En4D-Var on arrays: exact formulas, spread of many parameters, memory, what goes wrong."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.spatial.distance import cdist

from en4dvar.descent.field import field_en4dvar, field_esmda
from en4dvar.descent.field_data import FieldData
from en4dvar.plumbing.errors import En4dvarError
from en4dvar.priors.prior import member_stream
from en4dvar.schemes.local_gain import ByCorrelation, ByDistance, Split
from en4dvar.schemes.localisation import gaspari_cohn


def line(n: int, read: np.ndarray, radius: float) -> ByDistance:
    places = np.arange(float(n))[:, None]
    return ByDistance(places, places[read], radius)


def drawn(seed: int, purpose: str, std: np.ndarray, count: int) -> np.ndarray:
    """The centred perturbations of the observations, written out again."""
    z = np.array([member_stream(seed, purpose, i).standard_normal(len(std)) for i in range(count)])
    return std * (z - z.mean(axis=0))


def small(nonlinear: float = 0.0):
    rng = np.random.default_rng(3)
    n, read = 30, np.array([2, 3, 11, 17, 25])
    ensemble = np.cumsum(rng.standard_normal((8, n)), axis=1) / 3
    std = rng.uniform(0.2, 0.5, len(read))
    data = FieldData(rng.standard_normal(5), std, lambda x: x[:, read] + nonlinear * np.sin(x[:, read]), at_once=3)
    return ensemble, data, read


def schur(ensemble: np.ndarray, radius: float) -> np.ndarray:
    """ρ ∘ P (n, n) of an ensemble on a line."""
    places = np.arange(float(ensemble.shape[1]))[:, None]
    return gaspari_cohn(cdist(places, places), radius) * np.cov(ensemble.T)


def test_one_update_is_that_of_the_schur_product():
    """(ρ∘P)Hᵀ[H(ρ∘P)Hᵀ + R]⁻¹ with every matrix written out."""
    ensemble, data, read = small()
    H = np.eye(30)[read]
    P = schur(ensemble, 4.0)
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + np.diag(data.std**2))
    errors = drawn(7, "ES-MDA 0", data.std, 8)
    expected = ensemble + (data.values + errors - ensemble @ H.T) @ K.T
    found = ensemble.copy()
    field_esmda(found, data, line(30, read, 4.0), coefficients=(1.0,), seed=7)
    assert np.max(np.abs(found - expected)) < 1e-10


def test_en4dvar_of_a_linear_field_is_that_of_the_schur_product():
    ensemble, data, read = small()
    H, mean = np.eye(30)[read], ensemble.mean(axis=0)
    P = schur(ensemble, 4.0)
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + np.diag(data.std**2))
    errors = drawn(7, "En4D-Var field", data.std, 8)
    centre = mean + K @ (data.values - H @ mean)
    anomalies = ensemble - mean
    expected = centre + anomalies + (errors - anomalies @ H.T) @ K.T
    found = ensemble.copy()
    end = field_en4dvar(found, data, line(30, read, 4.0), seed=7, epsilon=1.0)
    assert end.converged
    assert np.max(np.abs(end.centre - centre)) < 1e-10
    assert np.max(np.abs(found - expected)) < 1e-10


def test_a_step_that_is_over_is_short_whatever_the_readings_errors():
    """In posterior standard deviations of predictions, which were lost to rounding: the next step had 1e134 of them."""
    ensemble, data, read = small()
    exact, told = FieldData(data.values, np.full(5, 1e-9), data.forward), []
    end = field_en4dvar(ensemble, exact, line(30, read, 4.0), tell=told.append)
    assert len(told) == 2
    assert told[1].step < 1e-3
    assert told[1].dfs == pytest.approx(5)
    assert end.stop.startswith("step of")


def test_en4dvar_of_a_nonlinear_field_minimises_the_cost():
    """J with the matrix ρ∘P written out, minimised by BFGS in the coordinates of its root; H reads sin of the field."""
    ensemble, data, read = small(nonlinear=0.9)
    mean, P = ensemble.mean(axis=0), schur(ensemble, 4.0)
    values, vectors = np.linalg.eigh(P)
    root = vectors * np.sqrt(np.maximum(values, 0))

    def cost(v: np.ndarray) -> float:
        return 0.5 * v @ v + 0.5 * np.sum(((data.values - data.forward((mean + root @ v)[None])[0]) / data.std) ** 2)

    best = minimize(cost, np.zeros(30), method="BFGS", options={"gtol": 1e-8, "maxiter": 500})
    end = field_en4dvar(
        ensemble, data, line(30, read, 4.0), epsilon=1e-5, tolerance=1e-6, cost_tolerance=0, max_iterations=60
    )
    assert end.converged
    assert end.costs == sorted(end.costs, reverse=True)
    assert end.costs[-1] == pytest.approx(best.fun, rel=1e-6)
    assert np.max(np.abs(end.centre - mean - root @ best.x)) < 1e-4


def test_the_background_of_many_iterates_is_the_sum_over_their_pairs(monkeypatch):
    """J_b = ½ Σ λ_iᵀ H_i B H_kᵀ λ_k, also where steps are shortened; each iterate meets those before it once."""
    rng, read, made, between = np.random.default_rng(1), np.arange(2, 30, 4), [], ByDistance.between
    monkeypatch.setattr(ByDistance, "between", lambda *them: made.append(1) or between(*them))

    def forward(x):
        return np.cumsum(np.exp(-x), axis=1)[:, read]

    ensemble = np.cumsum(rng.standard_normal((8, 30)), axis=1) / 3
    data = FieldData(forward(rng.standard_normal((1, 30)))[0], np.full(7, 0.3), forward)
    gain = line(30, read, 4.0)
    end = field_en4dvar(ensemble, data, gain, tolerance=1e-6, cost_tolerance=1e-9)
    iterates = len(end.costs)
    assert iterates > 6
    assert len(made) < iterates**2
    pairs = [*zip(end.tangents, end.duals, strict=True)]
    background = 0.5 * sum(a @ gain.between(Y, Z) @ b for Y, a in pairs for Z, b in pairs)
    assert end.background == pytest.approx(background, rel=1e-9)
    misfit = (data.values - end.prediction) / data.std
    assert end.costs[-1] == pytest.approx(background + 0.5 * misfit @ misfit, rel=1e-9)


def many(seed: int):
    """2000 parameters of variance 1, correlated over 5 neighbours, 100 members, 200 readings; the exact posterior."""
    rng = np.random.default_rng(seed)
    n, K = 2000, 200
    places = np.arange(float(n))
    P = np.exp(-0.5 * (np.subtract.outer(places, places) / 5) ** 2) + 1e-8 * np.eye(n)
    root = np.linalg.cholesky(P)
    ensemble = rng.standard_normal((100, n)) @ root.T
    read = np.arange(5, n, 10)
    std = np.full(K, 0.5)
    y = (root @ rng.standard_normal(n))[read] + std * rng.standard_normal(K)
    cross = P[:, read]
    exact = np.sqrt(np.diag(P) - np.sum(cross @ np.linalg.inv(P[np.ix_(read, read)] + np.diag(std**2)) * cross, axis=1))
    return ensemble, FieldData(y, std, lambda x: x[:, read], at_once=100), read, exact


class Everything:
    """The gain of the ensemble as it is."""

    def update(self, split, variance, innovations):
        Y = split.placed
        dual = np.linalg.solve(Y.T @ Y / (len(Y) - 1) + np.diag(variance), innovations.T).T
        return lambda part, anomalies: dual @ (Y.T @ anomalies) / (len(Y) - 1)


def spread(ensemble: np.ndarray) -> float:
    return float(np.sqrt(np.mean(ensemble.var(axis=0, ddof=1))))


def test_spread_of_many_parameters_is_the_exact_one_where_the_whole_ensemble_halves_it():
    ensemble, data, read, exact = many(0)
    wanted = float(np.sqrt(np.mean(exact**2)))
    whole = ensemble.copy()
    field_esmda(whole, data, Everything())
    assert spread(whole) < 0.6 * wanted
    for run in (field_esmda, field_en4dvar):
        found = ensemble.copy()
        run(found, data, line(2000, read, 12.0))
        assert spread(found) == pytest.approx(wanted, rel=0.1), run


def test_spread_of_parameters_without_a_place():
    """Each of 200 readings is about one of 2000 independent parameters, and nothing says which."""
    rng = np.random.default_rng(1)
    ensemble, of = rng.standard_normal((100, 2000)), rng.permutation(2000)[:200]
    std = np.full(200, 0.7)
    data = FieldData(rng.standard_normal(200), std, lambda x: x[:, of], at_once=100)
    exact = np.ones(2000)
    exact[of] = std / np.sqrt(1 + std**2)
    whole, found = ensemble.copy(), ensemble.copy()
    field_esmda(whole, data, Everything())
    field_esmda(found, data, ByCorrelation())
    assert spread(whole[:, of]) < 0.75 * np.sqrt(np.mean(exact[of] ** 2))
    assert spread(found) == pytest.approx(np.sqrt(np.mean(exact**2)), rel=0.1)
    assert spread(found[:, of]) == pytest.approx(np.sqrt(np.mean(exact[of] ** 2)), rel=0.1)


@pytest.mark.parametrize("members", [50, 200])
@pytest.mark.parametrize("kernel", [lambda d: np.exp(-(d**2) / 2), lambda d: np.exp(-d)])
def test_esmda_beside_what_has_no_place_is_the_closed_form(kernel, members: int):
    """A field whose prior is wide beside the errors, and its drift, which the whole ensemble does not confuse."""
    n, std, times = 40, 0.3, np.repeat([1.0, 2.0], 20)
    places = np.arange(float(n))[:, None]
    B = np.zeros((n + 1, n + 1))
    B[:n, :n], B[n, n] = 4 * kernel(cdist(places, places) / 3.0), 1.0
    root = np.linalg.cholesky(B + 1e-9 * np.eye(n + 1))
    for seed in range(4):
        rng = np.random.default_rng(seed)
        read = np.tile(np.sort(rng.choice(n, 20, replace=False)), 2)
        H = np.column_stack([np.eye(n)[read], times])
        values = H @ root @ rng.standard_normal(n + 1) + std * rng.standard_normal(40)
        K = B @ H.T @ np.linalg.inv(H @ B @ H.T + std**2 * np.eye(40))
        exact, spread = K @ values, np.sqrt(np.diag(B - K @ H @ B))
        found = rng.standard_normal((members, n + 1)) @ root.T
        near = ByDistance(np.vstack([places, [[np.nan]]]), places[read], 6.0)
        field_esmda(found, FieldData(values, np.full(40, std), lambda x, H=H: x @ H.T), near, seed=seed)
        off = (found.mean(axis=0) - exact) / spread
        assert np.sqrt(np.mean(off[:n] ** 2)) < 0.7, seed
        assert abs(off[n]) < 0.7, seed
        ratio = found.std(axis=0, ddof=1) / spread
        assert np.mean(ratio[:n]) == pytest.approx(1.0, abs=0.2), seed
        assert ratio[n] == pytest.approx(1.0, abs=0.25), seed


def test_esmda_regresses_on_what_has_no_place_and_tapers_the_rest():
    """One pass with B = A P_c Aᵀ + ρ ∘ P of what it leaves, every matrix written out."""
    ensemble, data, read = small()
    ensemble[:, 7] += ensemble[:, 0]
    common, placed = ensemble[:, 7:8] - ensemble[:, 7].mean(), np.delete(np.arange(30), 7)
    places = np.arange(30.0)[:, None]
    places[7] = np.nan
    X = ensemble - ensemble.mean(axis=0)
    along = common @ (common.T @ X) / (common.T @ common)
    B = np.cov(along.T)
    tapered = gaspari_cohn(cdist(places[placed], places[placed]), 4.0) * np.cov((X - along)[:, placed].T)
    B[np.ix_(placed, placed)] += tapered
    H = np.eye(30)[read]
    K = B @ H.T @ np.linalg.inv(H @ B @ H.T + np.diag(data.std**2))
    expected = ensemble + (data.values + drawn(7, "ES-MDA 0", data.std, 8) - ensemble @ H.T) @ K.T
    field_esmda(ensemble, data, ByDistance(places, places[read], 4.0), coefficients=(1.0,), seed=7)
    assert np.max(np.abs(ensemble - expected)) < 1e-10


def test_memory_is_that_of_the_ensemble_and_of_a_part():
    n, members = 60_000, 20
    rng = np.random.default_rng(0)
    ensemble = rng.standard_normal((members, n))
    read = np.arange(0, n, 600)
    places = np.arange(float(n))[:, None]
    data = FieldData(np.zeros(100), np.ones(100), lambda x: x[:, read], at_once=2)
    for run in (field_esmda, field_en4dvar):
        tracemalloc.start()
        run(ensemble, data, ByDistance(places, places[read], 1000.0))
        _, most = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert most < 2 * ensemble.nbytes, run  # beside the ensemble: three times in all


def test_what_cannot_be_run_leaves_the_prior(tmp_path):
    ensemble, data, read = small()
    before = ensemble.copy()
    broken = FieldData(data.values, data.std, lambda x: np.where(x[:, read] > 0, np.nan, x[:, read]))
    for run in (field_esmda, field_en4dvar):
        with pytest.raises(En4dvarError, match=r"\d+ of \d+ members have predictions that are not finite"):
            run(ensemble, broken, line(30, read, 4.0))
        assert np.allclose(ensemble, before, rtol=0, atol=1e-12)
    with pytest.raises(ValueError, match=r"without places use field_esmda"):
        field_en4dvar(ensemble, data, ByCorrelation())
    with pytest.raises(ValueError, match=r"places \(30,\) and observed \(5, 1\) must be"):
        ByDistance(np.arange(30.0), np.zeros((5, 1)), 1.0)


def test_by_correlation_each_cell_has_its_own_readings():
    """The formula cell by cell, of cells on which none, few and many readings act."""
    rng = np.random.default_rng(8)
    common = rng.standard_normal((20, 1))
    ensemble = rng.standard_normal((20, 40)) + np.where(np.arange(40) < 15, 3.0, 0.4) * common
    Y = rng.standard_normal((20, 14)) + np.linspace(0, 3, 14) * common
    X, Y = ensemble - ensemble.mean(axis=0), Y - Y.mean(axis=0)
    variance, innovations = rng.uniform(0.2, 1.0, 14), rng.standard_normal((5, 14))
    found, counts = ByCorrelation(0.5).update(Split(Y), variance, innovations)(slice(0, 40), X), []
    for j in range(40):
        near = np.array([abs(np.corrcoef(X[:, j], Y[:, k])[0, 1]) > 0.5 for k in range(14)])
        own = np.cov(Y[:, near].T).reshape(near.sum(), near.sum()) + np.diag(variance[near])
        gain = np.linalg.inv(own) @ (Y[:, near].T @ X[:, j]) / 19
        assert found[:, j] == pytest.approx(innovations[:, near] @ gain, abs=1e-12)
        counts.append(int(near.sum()))
    assert min(counts) == 0
    assert 0 < sorted(set(counts))[1] <= 8 < max(counts)
