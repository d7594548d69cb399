r"""What the Gaussian about a mode of J lacks: a mixture over the parameters of the errors, and bounds.

Where parameters h of the covariance K(h) of the errors are estimated (the noise scale, amplitude and length of a
discrepancy), the posterior is a mixture over them. At the mode of J these are too small, for a fit uses up degrees of
freedom, and a posterior at one value of them is too narrow. With the predictions linear about the mode,
m(u) = m(0) + M u in the other coordinates u ~ N(0, I), all that depends on h is known in closed form,

    p(h|y) ∝ N(y − m(0); 0, K + M Mᵀ) p(h),   u | h ~ N(P MᵀK⁻¹(y − m(0)), P),   P = (I + MᵀK⁻¹M)⁻¹,

and needs no run of the model; of a robust cost each h has Laplace's approximation in u, by one step from the mode.
Rates, where K has any, are those of the mode. p(h|y) is sampled by importance, half of the draws from Student's t about
the mode, or the mean of draws before, and half from the prior, as far as which a posterior of few readings may reach:
the mode of few degrees of freedom may lie outside of the posterior (Kennedy & O'Hagan 2001; nested
Laplace approximations: Rue, Martino & Chopin 2009, J. R. Stat. Soc. B 71, 319; Hesterberg 1995, Technometrics 37, 185).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from en4dvar.data.noise import BoundNoise, Linearisation, Predicted, sides_of
from en4dvar.descent.weight_space import WeightSpace
from en4dvar.ensemble.forecast import with_errors
from en4dvar.ensemble.linalg import effective_number, resampled, shares_of, with_moments
from en4dvar.model.state import Array, Mask
from en4dvar.priors.prior import Prior, member_stream
from en4dvar.problem import InverseProblem

DRAWS, FREEDOM = 250, 5.0  # of Student's t, and as many of the prior, for each parameter of the errors
WIDER = 1.3  # than the Gaussian at the mode
AT_ONCE = 50
ENOUGH, SOME = 60.0, 10.0  # effective draws below which the ensemble stays as it is; to draw again by, a parameter
ROUNDS = 3  # of draws, each after the first about the mean of those before
PARTICLES, SWEEPS = 2000, 40  # that bounds are imposed on; moves of each in the end


@dataclass(frozen=True)
class Drawn:
    """``members`` (N, n), transformed, of a posterior that is no Gaussian; ``cost``, J (B,) of control vectors (B, n)
    as far as predictions are linear about the mode, and ln p(y), ``log_evidence``, so far, but for the errors'
    normalisation.
    """

    members: Array
    cost: Callable[[Array], Array]
    log_evidence: float


def over_errors(space: WeightSpace, linear: Linearisation, mode: Array, posterior: Array) -> Drawn | None:
    """The mixture over the parameters of the errors in place of ``posterior`` (N, n), the Gaussian about the ``mode``
    (n,), all transformed. None where no such parameter is estimated, or members are too few for all coordinates.
    """
    problem, prior = space.problem, space.problem.prior
    prior = replace(prior, blocks=tuple(block.with_first(problem.of_errors) for block in prior.blocks))
    of_errors = np.array([name in problem.of_errors for name in prior.names])
    if not of_errors.any() or space.basis.shape[1] < len(mode):
        return None
    from scipy.special import gammaincinv, ndtri  # scipy is not needed to import the package

    stream, count = member_stream(space.seed, "parameters of the errors"), int(of_errors.sum())
    covariance = prior.white_covariance(np.atleast_2d(np.cov(posterior.T)))
    root = WIDER * np.linalg.cholesky(covariance[np.ix_(of_errors, of_errors)])
    about, half = prior.white(mode)[of_errors], DRAWS * count
    linearised = _Linear.of(space, linear, prior, prior.white(mode), of_errors)
    for _ in range(ROUNDS):
        # evenly along each coordinate (McKay, Beckman & Conover 1979, Technometrics 21, 239)
        ranks = stream.permuted(np.tile(np.arange(half), (2 * count + 1, 1)), axis=1)
        shares = (ranks + stream.uniform(size=ranks.shape)).T / half
        normal = ndtri(shares[:, 1:])
        heavy = normal[:, :count] / np.sqrt(gammaincinv(0.5 * FREEDOM, shares[:, :1]) / (0.5 * FREEDOM))
        draws = np.concatenate([about + heavy @ root.T, normal[:, count:]])
        log_prior = -0.5 * np.sum(draws**2, axis=1) - 0.5 * count * math.log(2 * math.pi)
        squares = np.sum(np.linalg.solve(root, (draws - about).T) ** 2, axis=0)
        norm = math.lgamma(0.5 * (FREEDOM + count)) - math.lgamma(0.5 * FREEDOM)
        norm -= 0.5 * count * math.log(FREEDOM * math.pi) + float(np.log(np.diag(root)).sum())
        log_t = norm - 0.5 * (FREEDOM + count) * np.log1p(squares / FREEDOM)
        log_marginal, means, roots, sizes = linearised.moments(draws)
        logs = log_marginal + log_prior - np.logaddexp(log_t, log_prior) + math.log(2)
        weights = shares_of(logs)
        effective = effective_number(weights)
        if effective >= ENOUGH or not effective >= SOME * count:  # also of NaN
            break
        about, root = weights @ draws, WIDER * np.linalg.cholesky(np.atleast_2d(np.cov(draws.T, aweights=weights)))
    if not effective >= ENOUGH:
        return None
    # members (N, n) of the mixture, in units of the prior: evenly along the size of the errors, random in u
    order = np.argsort(sizes)
    chosen = order[stream.permutation(resampled(weights[order], len(posterior), stream))]
    normal = stream.standard_normal((len(posterior), means.shape[1]))
    members = np.empty(posterior.shape)
    members[:, of_errors] = draws[chosen]
    members[:, ~of_errors] = means[chosen] + np.einsum("dij,dj->di", roots[chosen], normal)
    if space.settings.sampling == "exact":
        # The members mapped linearly so that mean and covariance are those of the whole mixture: h first, since a
        # coordinate takes in a share of each before it
        centres = np.hstack([draws, means])
        mean, share = weights @ centres, np.sqrt(weights)
        apart = np.zeros((roots.shape[2], *centres.shape))
        apart[..., count:] = np.moveaxis(share[:, None, None] * roots, 2, 0)
        rows = np.vstack([share[:, None] * (centres - mean), apart.reshape(-1, len(mode))])
        first = np.argsort(~of_errors, kind="stable")
        members[:, first] = with_moments(members[:, first], mean, np.asarray(np.linalg.qr(rows, mode="r")))
    evidence = float(np.logaddexp.reduce(logs)) - math.log(len(logs))
    return Drawn(prior.from_white(members), linearised.cost, evidence)


@dataclass(frozen=True)
class _Linear:
    """J with predictions linear about a ``mode`` (n,), with ``slopes`` (n, K), in white coordinates of a ``prior`` of
    which those of h do not depend on u. Where parameters of u are correlated with those of h, predictions depend on h.
    """

    problem: InverseProblem
    prior: Prior
    at: Predicted
    of_errors: Mask
    slopes: Array
    mode: Array

    @classmethod
    def of(cls, space: WeightSpace, linear: Linearisation, prior: Prior, mode: Array, of_errors: Mask) -> "_Linear":
        to_control = np.ascontiguousarray(prior.white_change((space.anomalies.T @ space.basis).T).T)
        slopes = np.linalg.pinv(to_control).T @ linear.anomalies
        if not any(space.problem.of_errors.intersection(block.names) for block in prior.blocks):
            slopes[of_errors] = 0.0  # but for the error of differences
        return cls(space.problem, prior, linear.prediction, of_errors, slopes, mode)

    def cost(self, x: Array) -> Array:
        """J (B,) of control vectors (B, n)."""
        z = self.prior.white(x)
        predicted = self._predicted(z[:, self.of_errors], self.at.values + (z - self.mode) @ self.slopes)
        return np.asarray(0.5 * np.sum(z**2, axis=1) + self.problem.observations.cost(predicted))

    def moments(self, draws: Array) -> tuple[Array, Array, Array, Array]:
        """ln p(y|h) (D,) but for the errors' normalisation, −inf where it is not known, of u the mean (D, n') and
        B (D, n', n') with the covariance BBᵀ, and the mean std of the errors (D,), for draws of h (D, n'').
        """
        each = [self._moments(draws[first : first + AT_ONCE]) for first in range(0, len(draws), AT_ONCE)]
        log, mean, root, size = (np.concatenate(parts) for parts in zip(*each, strict=True))
        return log, mean, root, size

    def _moments(self, draws: Array) -> tuple[Array, Array, Array, Array]:
        observations, rest = self.problem.observations, self.mode[~self.of_errors]
        apart = draws - self.mode[self.of_errors]
        of_h, of_u = self.slopes[self.of_errors], self.slopes[~self.of_errors]
        predicted = self._predicted(draws, self.at.values + apart @ of_h)
        log = -observations.cost(predicted) - 0.5 * rest @ rest
        possible = np.isfinite(log)
        rows = np.vstack([of_u, observations.values - self.at.values, of_h])
        # Least squares in u − rest: readings, then the prior, the right-hand side last
        white = np.zeros((len(draws), len(self.at.values), len(rows)))
        white[possible] = observations.whitened_rows(rows, predicted[possible]).swapaxes(1, 2)
        if not observations.noise.quadratic:
            white[possible, :, len(of_u)] *= observations.noise.pulls(observations.values, predicted[possible])
        readings, moved = np.split(white, [len(of_u) + 1], axis=2)
        readings[:, :, -1] -= np.einsum("dkh,dh->dk", moved, apart)
        prior = np.tile(np.column_stack([np.eye(len(rest)), -rest]), (len(draws), 1, 1))
        triangle = np.asarray(np.linalg.qr(np.concatenate([readings, prior], axis=1), mode="r"))
        root, side = np.linalg.inv(triangle[:, :-1, :-1]), triangle[:, :-1, -1]
        log += 0.5 * np.sum(side**2, axis=1) + np.log(np.abs(np.diagonal(root, axis1=1, axis2=2))).sum(axis=1)
        size = observations.noise.total_std(predicted).mean(axis=1)
        return log, rest + np.einsum("dij,dj->di", root, side), root, size

    def _predicted(self, draws: Array, values: Array) -> Predicted:
        """Predictions ``values`` (D, K) beside draws of h (D, n'')."""
        z = np.zeros((len(draws), len(self.mode)))
        z[:, self.of_errors] = draws
        physical = self.prior.to_physical(self.prior.from_white(z))
        rates = None if self.at.rates is None else np.tile(self.at.rates, (len(draws), 1))
        return with_errors(self.problem, physical, values, rates)


def beside_bounds(space: WeightSpace, linear: Linearisation, w: Array, cost: float) -> Drawn | None:
    """The posterior about its mode, of weights w (N,) and J ``cost``, where readings are bounds: the Gaussian of all
    else, cut off softly. None where none is.

    About a minimum of J the curvature of a bound is that of a Gaussian on one side and zero on the other, so no
    Gaussian is near. With the predictions linear about it, all but the bounds is a Gaussian in closed form; on its
    draws, moved to the mode, the bounds are imposed by degrees (sequential Monte Carlo: Del Moral, Doucet & Jasra 2006,
    J. R. Stat. Soc. B 68, 411), with elliptical slice sampling (Murray, Adams & MacKay 2010, AISTATS 9, 541), which
    needs no run of the model.
    """
    observations, basis = space.problem.observations, space.basis
    sides = sides_of(observations.noise)
    bounds = sides != 0
    if not bounds.any():
        return None
    d, S = observations.whiten(linear)
    others = np.resize(~bounds, len(d))
    d, S = d[others], S[others]
    n_members, r = basis.shape
    prior = np.sqrt(n_members - 1)
    orthogonal, root = np.linalg.qr(np.vstack([S, prior * np.eye(r)]))
    middle = np.linalg.solve(root, orthogonal.T @ np.concatenate([d, -prior * basis.T @ w]))
    noise = BoundNoise(observations.noise.std[bounds], observations.noise.time_std[bounds], sides[bounds])
    values, weights = observations.values[bounds], observations.weights[bounds]
    at, slopes = linear.prediction.values[bounds], linear.anomalies[:, : len(bounds)][:, bounds]

    def moved(z: Array) -> Array:
        """Coordinates (B, r) about w of points z (B, r) that are N(0, I) but for the bounds."""
        return np.asarray(middle + np.linalg.solve(root, z.T).T)

    def of_bounds(z: Array) -> Array:
        """J_o (B,) of the bounds alone."""
        return noise.cost(values, weights, Predicted(at + moved(z) @ slopes))

    stream, mode = member_stream(space.seed, "bounds"), root @ -middle

    def of_shifted(v: Array) -> Array:
        """What N(mode, I), where the posterior is, needs to be N(0, I) with the bounds, at v (B, r) from the mode."""
        return np.asarray(of_bounds(mode + v) + v @ mode + 0.5 * mode @ mode)

    lowest = cost - float(of_shifted(np.zeros((1, r)))[0])  # J of all else at its own minimum
    v, log_share = _imposed(stream.standard_normal((max(PARTICLES, n_members), r)), of_shifted, stream)
    z = mode + v[:n_members]
    log_det = 2 * float(np.log(np.abs(np.diag(root)) / prior).sum())

    def cost_of(x: Array) -> Array:
        z = ((space.weights_of(x) - w) @ basis - middle) @ root.T
        return np.asarray(lowest + 0.5 * np.sum(z**2, axis=1) + of_bounds(z))

    return Drawn(space.control(w + moved(z) @ basis.T), cost_of, log_share - lowest - 0.5 * log_det)


def _imposed(z: Array, cost: Callable[[Array], Array], stream: np.random.Generator) -> tuple[Array, float]:
    """Draws (B, r) of N(0, I) exp(−cost) in place of draws ``z`` of N(0, I), and ln E[exp(−cost)] of these: by powers
    of exp(−cost), each of which leaves half of the draws effective.
    """
    power, log_share = 0.0, 0.0
    while power < 1:
        costs, step = cost(z), 1 - power
        while effective_number(shares_of(-step * costs)) < 0.5 * len(z):
            step *= 0.7
        power, logs = (1.0 if step == 1 - power else power + step), -step * costs
        log_share += float(np.logaddexp.reduce(logs)) - math.log(len(z))
        z = z[stream.permutation(resampled(shares_of(logs), len(z), stream))]
        for _ in range(SWEEPS if power == 1 else SWEEPS // 5):
            z = _moved(z, cost, power, stream)
    return z, log_share


def _moved(z: Array, cost: Callable[[Array], Array], power: float, stream: np.random.Generator) -> Array:
    """A move of each point z (N, r), drawn from N(0, I) exp(−power · cost), along an ellipse through it, its arc shrunk
    until the draw is accepted.
    """
    other, level = stream.standard_normal(z.shape), power * cost(z) - np.log(stream.uniform(size=len(z)))
    angle = stream.uniform(0, 2 * np.pi, size=len(z))
    low, high = angle - 2 * np.pi, angle.copy()
    while True:
        moved = z * np.cos(angle)[:, None] + other * np.sin(angle)[:, None]
        refused = power * cost(moved) > level
        if not refused.any():
            return moved
        low, high = np.where(refused & (angle < 0), angle, low), np.where(refused & (angle >= 0), angle, high)
        angle = np.where(refused, stream.uniform(low, high), angle)
