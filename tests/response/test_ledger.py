"""The ledger: weights with a known answer, that sum to one whatever the units."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from toys import make_observations

from en4dvar.assimilate import assimilate
from en4dvar.forward import Failure, ForwardModel, Observable, PathQuantity, StateField
from en4dvar.prior import Prior, PriorTerm
from en4dvar.problem import AssimilationSettings, InverseProblem
from en4dvar.response.ledger import CELLS, weighted_quantiles
from en4dvar.state import Field, Parameter, StateLayout

BEGIN, END = 0.5, 0.9
SETTINGS = AssimilationSettings(members=12)


def worked(t):
    """How long the parameter has acted by time t."""
    return np.clip(t, BEGIN, END) - BEGIN


class Acting(ForwardModel):
    """ẋ = θ u(t) with u = 1 between 0.5 and 0.9; x(0) = x0, which is not of the path."""

    def __init__(self, scale=1.0):
        self.scale = scale  # of the unit of θ
        self.parameters = (Parameter("theta", "1"), Parameter("x0", "1"))
        self.layout = StateLayout((Field("x"), Field("u"), Field("theta"), Field("x0")))
        self.observables = (Observable("x", "1", StateField("x")),)
        self.path_quantities = (PathQuantity("u", "1", label="input"), PathQuantity("x", "1"))
        self.path_parameters = ("theta",)

    def initial_state(self, theta):
        return np.array([theta["x0"], 0.0, theta["theta"], theta["x0"]])

    def step(self, x, t0, t1):
        moved = self.scale * x[2] * (worked(t1) - worked(t0))
        return np.array([x[0] + moved, float(BEGIN <= t1 <= END), x[2], x[3]])


class Breaking(Acting):
    """Cannot be resumed."""

    def resumed(self, x, start, times):
        return [Failure("no")] * len(x)


def problem(times, model=None, std=0.1):
    model = model or Acting()
    values = 1.0 + 2.0 * worked(np.asarray(times))
    terms = (
        PriorTerm.normal(model.parameters[0], 1.5 / model.scale, 1.0 / model.scale),
        PriorTerm.normal(model.parameters[1], 1.0, 0.5),
    )
    return InverseProblem(model, model.observables[0], make_observations(times, values, std), Prior(terms))


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
    of.model.path_quantities = ()
    assert assimilate(of, SETTINGS, 1).ledger is None
    assert np.isnan(assimilate(problem([1.0, 1.2, 1.5], Breaking()), SETTINGS, 1).ledger.weights).all()


def test_runs_are_counted():
    model = Acting()
    counted = assimilate(problem([1.0, 1.2, 1.5], model), SETTINGS, 1)
    model = Acting()
    model.path_parameters = ()
    without = assimilate(problem([1.0, 1.2, 1.5], model), SETTINGS, 1)
    assert counted.ledger.runs == 1 + 2 * CELLS
    assert counted.forward_runs - without.forward_runs == counted.ledger.runs


def test_weighted_quantiles_of_equal_weights():
    values = np.arange(1000.0)[::-1]
    found = weighted_quantiles(values, np.full(1000, 1e-3))
    np.testing.assert_allclose(found, [49.5, 499.5, 949.5])
