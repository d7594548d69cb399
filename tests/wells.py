"""Two wells: a posterior of two modes."""

from dataclasses import replace

import numpy as np
from toys import Closed, cost_by_definition, make_observations, make_problem

from en4dvar.priors.prior import PriorTerm


class Wells(Closed):
    """y = f(a) + b t with f(a) = a² (two wells alike) or, for a > 0, (3 a)² (one of them three times as narrow)."""

    narrow, of_arrays = False, True

    def curve(self, theta, t):
        a, b = theta
        return np.where(self.narrow & (a > 0), 3 * a, a) ** 2 + b * t

    def rate(self, theta, t):
        return theta[1]


class UnlikeWells(Wells):
    narrow = True


class Parting(Wells):
    """Two wells until t = 2; from then on y grows or falls by 3 a, which tells them apart."""

    def curve(self, theta, t):
        return super().curve(theta, t) + 3 * theta[0] * np.maximum(t - 2, 0)

    def rate(self, theta, t):
        return super().rate(theta, t) + 3 * theta[0] * (t > 2)


class Hidden(Wells):
    """y = f(a) + b t, f = 2 tanh a but 2 to 8 in a narrow piece, -1.6 < a < -1.4, from which J leads away."""

    def curve(self, theta, t):
        a, b = theta
        return np.where(np.abs(a + 1.5) < 0.1, 2 + 30 * (a + 1.6), 2 * np.tanh(a)) + b * t


class Chord(Wells):
    """y = a sin 3 b t and eight slow waves that change it little: J has many minima in b, of which most descents end in
    one of their own.
    """

    def __init__(self):
        super().__init__((*"ab", *(f"c{j}" for j in range(8))), compiled=True)

    def curve(self, theta, t):
        a, b, *slow = theta
        return a * np.sin(3 * b * t) + sum(c * np.cos((j + 1) * t / 4) for j, c in enumerate(slow))

    def rate(self, theta, t):
        return np.zeros(np.broadcast_shapes(np.shape(theta[0]), np.shape(t)))


def chord(seed):
    """Noise as large as the wave: wrong minima are plausible, too. b = 9, known as 3 ± 6."""
    model = Chord()
    stds = (0.3, 6.0, *[0.5] * 8)
    terms = tuple(map(PriorTerm.normal, model.parameters, (1.0, 3.0, *[0.0] * 8), stds))
    return make_problem(model, [1.0, 9.0, *[0.1] * 8], std=1.2, prior=terms, seed=seed, k=60)


def hidden_well(seed):
    """Readings that only the narrow piece explains, with a = -1.5."""
    model = Hidden(compiled=True)
    a, b = model.parameters
    terms = (PriorTerm.normal(a, 0.0, 1.0), PriorTerm.normal(b, 0.0, 0.5))
    return make_problem(model, [-1.5, 0.3], std=0.2, prior=terms, seed=seed)


def two_wells(kind=Wells, compiled=True, mean=0.3, seed=1):
    model = kind(compiled=compiled)
    a, b = model.parameters
    terms = (PriorTerm.normal(a, mean, 1.0), PriorTerm.normal(b, 0.0, 0.5))
    return make_problem(model, [-1.0, 0.3], std=0.2, prior=terms, seed=seed)


def parted(kind=Parting, mean=0.3, seed=1, off=0.0, **options):
    """Two wells whose readings after the window are of the left one, and ``off`` by so much."""
    problem = two_wells(kind, mean=mean, seed=seed, **options)
    y, times = problem.observations, np.linspace(2.2, 4.0, 8)
    later = problem.model.curve(np.array([-1.0, 0.3]), times) + off
    later = later + 0.2 * np.random.default_rng([3, seed]).standard_normal(len(times))
    whole = make_observations(np.append(y.times, times), np.append(y.values, later), 0.2)
    return replace(problem, observations=replace(y, continued=whole))


def mass_and_evidence(problem):
    """Of a > 0, and ln p(y), on a grid."""
    (a, b), o = problem.prior.terms, problem.observations
    axes = [term.mean + term.std * np.linspace(-5, 5, 161) for term in (a, b)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    logs = -sum(cost_by_definition(problem, grid))
    p = np.exp(logs - logs.max())
    cell = (10 / 160) ** 2 / (2 * np.pi)  # in prior standard deviations, beside their norm
    evidence = logs.max() + np.log(p.sum() * cell) - np.sum(np.log(o.std * np.sqrt(2 * np.pi)))
    return p[grid[:, 0] > 0].sum() / p.sum(), float(evidence)
