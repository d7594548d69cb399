"""A kind of observation errors of somebody else's: it is used as it is, and what does not fit together is named."""

import math
import re
from dataclasses import dataclass, replace

import numpy as np
import pytest
from toys import Linear, make_problem

from en4dvar.data.noise import BoundNoise, DecayingErrors, HuberNoise, Noise, joint_noise, noise_of
from en4dvar.data.noise.gaussian import Linearisation, Predicted
from en4dvar.data.noise.make import noise_of_readings
from en4dvar.data.noise.own import _Trial
from en4dvar.data.observations import Observations
from en4dvar.estimation.assimilate import assimilate
from en4dvar.plumbing.errors import DataError
from en4dvar.schemes.settings import AssimilationSettings

K = 12
STD = np.full(K, 0.5)


@dataclass(frozen=True)
class Student(Noise):
    """Student's t with ``freedom`` degrees of freedom."""

    freedom: float = 3.0

    counts_within = 1.0

    @property
    def scale_information(self):
        return 2 * self.freedom / (self.freedom + 3)

    @property
    def words(self):
        return f", Student's t with {self.freedom:g} degrees of freedom"

    def influence(self, residual):
        return (self.freedom + 1) / (self.freedom + residual**2)

    def attributes(self):
        return {"student_freedom": self.freedom}

    def _white(self, stream, shape):
        return stream.standard_t(self.freedom, shape)

    def _loss(self, v):
        return (self.freedom + 1) / 2 * np.log1p(v * v / self.freedom)

    def _log_norm(self):
        n = self.freedom
        return 0.5 * math.log(n * math.pi) + math.lgamma(n / 2) - math.lgamma((n + 1) / 2)


def observed(noise):
    return Observations(np.arange(1.0, K + 1), np.zeros(K), noise=noise, weights=np.ones(K))


@pytest.mark.parametrize("freedom", [1.0, 3.0, 30.0])
def test_one_that_keeps_its_promises_is_used(freedom):
    noise = Student(STD, 0 * STD, freedom)
    assert observed(noise).noise is noise


def test_its_mode_is_that_of_its_density():
    """One unknown, a line through readings of which one is far off: the mode by a fine grid of the cost."""
    problem = make_problem(Linear(("a",)), [1.0])
    values = problem.observations.values.copy()
    values[4] += 8.0
    std = np.full(len(values), 0.3)
    observations = replace(problem.observations, values=values, noise=Student(std, 0 * std))
    problem = replace(problem, observations=observations)
    analysis = assimilate(problem, AssimilationSettings(members=8, what_if=False, refine="none", emulator="off"), 1)
    grid = np.linspace(-1, 3, 4001)
    path = problem.model.trajectories(problem.model.initial_states({"a": np.array([1.0])}), observations.times)[0]
    m = np.multiply.outer(grid, problem.observable.operator(path))
    (term,) = problem.prior.terms
    cost = 2 * np.log1p(((values - m) / 0.3) ** 2 / 3).sum(axis=1) + (grid - term.mean) ** 2 / (2 * term.std**2)
    assert analysis.centre[0] == pytest.approx(grid[np.argmin(cost)], abs=2e-3)


@pytest.mark.parametrize("freedom", [3.0, np.linspace(2.0, 5.0, K)])
def test_its_curvature_is_that_expected_of_its_density(freedom):
    """Of Student's t (n + 1)/(n + 3). By ρ′/v, whose mean is 1, intervals were too narrow."""
    noise = Student(STD, 0 * STD, freedom)
    (_, rows), least = noise.whiten(np.zeros(K), np.ones(K), Linearisation(Predicted(np.zeros(K)), STD[None])), 1 / 3
    np.testing.assert_allclose(rows[:, 0] ** 2, np.broadcast_to((freedom + 1) / (freedom + 3), K), rtol=1e-4)
    assert noise.whitened_rows(np.zeros(K), STD[None], Predicted(np.full((1, K), 9.0)))[0, 0, -1] ** 2 < least


class HalfStudent(Student):
    """Gaussian errors of the first half of the readings."""

    def influence(self, residual):
        return np.where(np.arange(K) < K // 2, 1.0, super().influence(residual))

    def _loss(self, v):
        half = K // 2
        return np.concatenate([0.5 * v[..., :half] ** 2, super()._loss(v[..., half:])], axis=-1)


def test_the_expected_curvature_of_readings_that_are_told_apart_by_their_place():
    """A loss is of (…, K): asked for that of a single column it gave that of the first reading for all."""
    expected = np.where(np.arange(K) < K // 2, 1.0, 4 / 6)
    np.testing.assert_allclose(HalfStudent(STD, 0 * STD).expected_curvature, expected, rtol=1e-4)


def test_a_down_weighted_reading_is_told_as_far_off_as_it_is():
    """Not the threshold over its weight, which is so of Huber's ρ with one threshold alone."""
    problem = make_problem(Linear(("a",)), [1.0])
    values, far = problem.observations.values.copy(), len(problem.observations) - 1
    values[far] += 6.0
    half, std = len(values) // 2, np.full(len(values), 0.3)
    thresholds = np.where(np.arange(len(values)) < half, 1.0, 3.0)
    for noise in (Student(std, 0 * std), noise_of_readings(std, 0 * std, thresholds=thresholds)):
        own = replace(problem, observations=replace(problem.observations, values=values, noise=noise))
        analysis = assimilate(own, AssimilationSettings(members=8, what_if=False, refine="none", emulator="off"), 1)
        off = abs(values[far] - analysis.centre_predictions[far]) / 0.3
        (told,) = (str(c) for c in analysis.cautions if c.code == "down-weighted")
        assert f"down-weighted: at {problem.observations.times[far]:.4g} s ({off:.2g} std off, " in told


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"influence": lambda s, v: None}, "influence gives None; it gives finite numbers of shape (2, 12)"),
        ({"influence": lambda s, v: v.size_}, "influence raises AttributeError: 'numpy.ndarray' object has no"),
        ({"influence": lambda s, v: 1 / (1 + v**2)}, "its cost has the slope "),
        ({"_loss": lambda s, v: float(np.sum(v))}, "_loss gives shape (); it gives finite numbers of shape (2, 12)"),
        ({"_log_norm": lambda s: 0.0}, "its density integrates to 2.7"),
        ({"_white": lambda s, stream, shape: stream.standard_normal(shape)}, "not 1; _white draws v from"),
        ({"_white": lambda s, stream, shape: stream.standard_normal(3)}, "drawn raises ValueError: operands"),
        ({"counts_within": math.inf}, "it says that its cost is quadratic, which it is not; counts_within is"),
        ({"counts_within": lambda s: 1.0}, "it is a number, or a property that gives one"),
        ({"scale_information": lambda s: 1.0}, "it is a number, or a property that gives one"),
        ({"scale_information": 2.0}, "scale_information is 2, by draws "),
        ({"words": 3}, "words is 3; it is a text"),
        ({"frozen": lambda s, at: None}, "frozen gives None; it gives a Noise"),
    ],
)
def test_what_does_not_fit_together_is_named(changed, words):
    kind = type("Mine", (Student,), changed)
    with pytest.raises(DataError) as caught:
        observed(kind(STD, 0 * STD))
    assert re.search(f"^data: Mine: .*{re.escape(words)}", str(caught.value))


@pytest.mark.parametrize(
    ("noise", "words"),
    [
        (0.5, "noise is 0.5; give a Noise, such as noise_of(std)"),
        (Noise(STD.tolist(), (0 * STD).tolist()), "std is no array; give np.array(std)"),
    ],
)
def test_what_is_no_kind_of_errors_is_refused(noise, words):
    with pytest.raises(DataError) as caught:
        observed(noise)
    assert words in str(caught.value)


@pytest.mark.parametrize(
    "noise",
    [
        Noise(STD, 0 * STD), HuberNoise(STD, 0 * STD, 1.3), BoundNoise(STD, 0 * STD, np.resize([1.0, -1.0], K)),
        noise_of(STD, None, DecayingErrors(np.arange(K) / 3)),
    ],
    ids=lambda noise: type(noise).__name__,
)  # fmt: skip
def test_ours_pass_the_same_trial(noise):
    _Trial(noise, np.linspace(0.1, 2.0, K))()


def test_beside_another_series_it_is_refused_by_its_name():
    times, noises = [np.arange(K)] * 2, [Noise(STD, 0 * STD), Student(STD, 0 * STD)]
    with pytest.raises(ValueError, match="errors of the kind Student are not possible beside other series"):
        joint_noise(times, noises, np.eye(2))
