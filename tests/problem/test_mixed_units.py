"""Parameters and variables whose sizes differ by many powers of ten, as a pressure in Pa and a time in s do: what is
estimated, and all that is said of it, is the same as in units in which they are alike.
"""

from dataclasses import replace

import numpy as np
import pytest
from toys import make_problem
from wells import Wells

from en4dvar.descent.minima import Minimum
from en4dvar.ensemble.linalg import least_coordinates
from en4dvar.estimation.assimilate import assimilate
from en4dvar.priors.prior import Prior, PriorTerm
from en4dvar.sampling.alike import standing_for
from en4dvar.schemes.settings import AssimilationSettings
from en4dvar.series.settings import EnRTS

SIZES = np.array([1.0, 2.0**20, 2.0**-40])


class OtherUnits(Wells):
    """Two wells, of parameters that are ``sizes`` times as large."""

    sizes = (1.0, 1.0)

    def curve(self, theta, t):
        return super().curve([value / size for value, size in zip(theta, self.sizes, strict=True)], t)

    def rate(self, theta, t):
        return theta[1] / self.sizes[1]


def in_units(sizes):
    problem = make_problem(OtherUnits(), (1.0, 0.5), prior=None)
    model = OtherUnits()
    model.sizes = sizes
    scaled = zip(model.parameters, problem.prior.terms, sizes, strict=True)
    terms = tuple(PriorTerm.normal(p, size * term.mean, size * term.std) for p, term, size in scaled)
    return replace(problem, model=model, prior=Prior(terms))


@pytest.mark.parametrize("change", [{}, {"scheme": "es-mda"}])
def test_an_estimate_is_the_same_in_other_units(change):
    sizes = SIZES[1:]
    alike, mixed = (assimilate(in_units(of), AssimilationSettings(**change), 3) for of in ((1.0, 1.0), sizes))
    np.testing.assert_allclose(mixed.posterior / sizes, alike.posterior, rtol=1e-9)
    assert mixed.forward_runs == alike.forward_runs  # of the search for minima, too
    np.testing.assert_allclose(mixed.influence.in_std, alike.influence.in_std, rtol=1e-6, atol=1e-9)
    assert mixed.log_evidence == pytest.approx(alike.log_evidence, abs=1e-9)


def test_the_distance_from_a_minimum_counts_every_parameter():
    """Each three of its own standard deviations away; together by a correlation of 0.6, in closed form."""
    correlation = np.eye(3) + 0.6 * (np.eye(3, k=2) + np.eye(3, k=-2))
    minimum = Minimum(np.zeros(3), correlation * np.outer(SIZES, SIZES), 0.0)
    expected = [np.sqrt(9 / 0.64), 3.0, np.sqrt(9 / 0.64)]
    assert [minimum.distance(row) for row in np.diag(3 * SIZES)] == pytest.approx(expected)
    assert minimum.distance(3 * SIZES) == pytest.approx(np.sqrt(18 / 1.6 + 9))


def test_the_distance_from_a_minimum_is_that_along_the_directions_it_has():
    known = np.array([1.0, -2.0, 0.5]) * SIZES
    flat = Minimum(np.zeros(3), np.outer(known, known), 0.0)
    assert flat.distance(2 * known) == pytest.approx(2.0)
    still = Minimum(np.zeros(2), np.diag([SIZES[1] ** 2, 0.0]), 0.0)
    assert still.distance(np.array([SIZES[1], 1.0])) == pytest.approx(1.0)


@pytest.mark.parametrize("rows", [3, 9])
def test_the_shortest_coordinates_reach_every_change(rows):
    stream = np.random.default_rng(5)
    directions, coordinates = stream.standard_normal((rows, 3)) * SIZES, stream.standard_normal((4, rows))
    changes = coordinates @ directions
    found = least_coordinates(directions, changes)
    np.testing.assert_allclose(found @ directions / SIZES, changes / SIZES, rtol=0, atol=1e-12)
    np.testing.assert_allclose(found, changes / SIZES @ np.linalg.pinv(directions / SIZES), rtol=0, atol=1e-12)


@pytest.mark.parametrize("widened", [False, True])
def test_a_smoother_takes_every_variable_back(widened):
    """Later observations say of the last variable what they say of it in other units."""

    def smoothed(sizes):
        stream, trail, states = np.random.default_rng(1), list[np.ndarray](), dict[int, np.ndarray]()
        ensemble, turn = stream.standard_normal((20, 3)), stream.standard_normal((3, 3)) / 2
        for cycle in range(4):
            made = ensemble @ turn.T
            forecasts = [made, 1.1 * made] if widened else [made]
            weights = np.eye(20) + 0.1 * stream.standard_normal((20, 20))
            ensemble = weights @ (forecasts[-1] - forecasts[-1].mean(axis=0))
            EnRTS().passed(trail, cycle, [each * sizes for each in forecasts], [ensemble * sizes], None, None)
        EnRTS().ended(trail, 3, lambda cycle, of_it: states.update({cycle: of_it / sizes}))
        return np.stack([states[cycle] for cycle in range(4)])

    np.testing.assert_allclose(smoothed(SIZES), smoothed(np.ones(3)), rtol=0, atol=1e-9)


def test_few_draws_stand_for_all_in_any_units():
    stream = np.random.default_rng(2)
    x = stream.standard_normal((400, 3))
    alike, mixed = (
        standing_for(x * sizes, np.arange(48), x.mean(axis=0) * sizes, np.cov((x * sizes).T)) / sizes
        for sizes in (np.ones(3), SIZES)
    )
    assert not np.array_equal(alike, x[:48])  # some are exchanged
    np.testing.assert_allclose(mixed, alike)
