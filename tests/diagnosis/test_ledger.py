"""The ledger: weights with a known answer, that sum to one whatever the units."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from acting import BEGIN, END, Acting, worked
from acting import acting_problem as problem

from en4dvar.diagnosis.response.ledger import CELLS, weighted_quantiles
from en4dvar.estimation.assimilate import assimilate
from en4dvar.model.forward import Failure
from en4dvar.priors.prior import Prior
from en4dvar.schemes.settings import AssimilationSettings

SETTINGS = AssimilationSettings(members=12)


class Breaking(Acting):
    """Cannot be resumed."""

    def resumed(self, x, start, times):
        return [Failure("no")] * len(x)


def expected_kernel(of, edges):
    """Σ_k G_k ∂m_k/∂θ within each cell, from the normal equations."""
    times, std, prior = of.observations.times, of.observations.std, of.prior
    H = np.column_stack([worked(times), np.ones(len(times))])
    A = H.T @ (H / std[:, None] ** 2) + np.diag(prior.std**-2.0)
    gain = np.linalg.solve(A, H.T / std**2)
    within = np.diff(worked(np.minimum.outer(times, edges)), axis=1)
    return gain[0] @ within


@pytest.mark.parametrize("times", [[1.0, 1.2, 1.5, 2.0], [0.2, 0.6, 0.7, 0.8, 1.4]])
def test_kernel_and_weights_are_those_of_the_closed_form(times):
    of = problem(times)
    book = assimilate(of, SETTINGS, 1).ledger
    expected = expected_kernel(of, book.edges)
    np.testing.assert_allclose(book.kernel[0], expected, rtol=0, atol=1e-10)
    np.testing.assert_allclose(book.weights[0], np.abs(expected) / np.abs(expected).sum(), rtol=0, atol=1e-9)


def test_readings_after_the_fact_credit_the_time_at_which_the_parameter_acted():
    book = assimilate(problem([1.0, 1.2, 1.5, 2.0]), SETTINGS, 1).ledger
    outside = (book.edges[1:] <= BEGIN) | (book.edges[:-1] >= END)
    assert outside.sum() > CELLS / 4
    np.testing.assert_allclose(book.weights[0, outside], 0.0, atol=1e-12)
    low, median, high = book.quantiles[0, 0]
    assert (median, high) == (1.0, 1.0)  # of the input, though it is zero whenever x is read
    assert low > 0.5


def test_the_kernel_sums_to_the_degrees_of_freedom():
    """All of θ's action is along the path, so that the whole of its information is."""
    of = problem([0.6, 0.7, 1.0, 1.2])
    analysis = assimilate(of, SETTINGS, 1)
    assert analysis.ledger.parameters == ("theta",)
    assert analysis.ledger.kernel[0].sum() == pytest.approx(analysis.dfs_per_parameter[0], abs=1e-9)


def test_weights_sum_to_one_whatever_the_unit():
    times = [0.2, 0.6, 0.7, 0.8, 1.4]
    one, other = (assimilate(problem(times, Acting(scale)), SETTINGS, 1).ledger for scale in (1.0, 1e6))
    assert one.weights.sum(axis=1) == pytest.approx([1.0], abs=1e-12)
    np.testing.assert_allclose(one.weights, other.weights, rtol=0, atol=1e-9)


def test_what_is_not_informed_along_the_path_has_no_weights():
    book = assimilate(problem([0.1, 0.2, 0.3]), SETTINGS, 1).ledger
    assert np.isnan(book.weights).all()
    assert np.isnan(book.quantiles).all()


def test_no_ledger_without_quantities_and_nan_where_runs_fail():
    of = problem([1.0, 1.2, 1.5])
    fixed = replace(of, prior=Prior(of.prior.terms[1:]), fixed={"theta": 2.0})
    assert assimilate(fixed, SETTINGS, 1).ledger is None
    assert assimilate(of, replace(SETTINGS, what_if=False), 1).ledger is None
    of.model.path_quantities = ()
    assert assimilate(of, SETTINGS, 1).ledger is None
    assert np.isnan(assimilate(problem([1.0, 1.2, 1.5], Breaking()), SETTINGS, 1).ledger.weights).all()


class Raising(Acting):
    """Ends in the middle of what nobody asked for."""

    def resumed(self, x, start, times):
        raise SystemExit(3)


class Interrupted(Acting):
    def resumed(self, x, start, times):
        raise KeyboardInterrupt


def test_a_model_that_raises_keeps_its_posterior():
    assert assimilate(problem([1.0, 1.2, 1.5], Raising()), SETTINGS, 1).ledger is None
    with pytest.raises(KeyboardInterrupt):
        assimilate(problem([1.0, 1.2, 1.5], Interrupted()), SETTINGS, 1)


def test_runs_are_counted():
    model = Acting()
    counted = assimilate(problem([1.0, 1.2, 1.5], model), SETTINGS, 1)
    model = Acting()
    model.path_parameters = ()
    without = assimilate(problem([1.0, 1.2, 1.5], model), SETTINGS, 1)
    assert counted.ledger.runs == 2 + 2 * CELLS
    assert counted.forward_runs - without.forward_runs == counted.ledger.runs


def test_weighted_quantiles_of_equal_weights():
    values = np.arange(1000.0)[::-1]
    found = weighted_quantiles(values, np.full(1000, 1e-3))
    np.testing.assert_allclose(found, [49.5, 499.5, 949.5])
