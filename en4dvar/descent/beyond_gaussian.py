r"""What the Gaussian about a mode of J lacks: a mixture, bounds, and a mean beyond the mode.

Beside an estimated discrepancy the posterior is a mixture over amplitude, length and noise scale. At the mode
of J these are too small, for a fit uses up degrees of freedom, and a posterior at one value of them is too narrow. With
the predictions linear about the mode, m(u) = m(0) + M u in the other coordinates u ~ N(0, I), all that depends on the
parameters h of the covariance K(h) is known in closed form,

    p(h|y) ∝ N(y − m(0); 0, K + M Mᵀ) p(h),   u | h ~ N(P MᵀK⁻¹(y − m(0)), P),   P = (I + MᵀK⁻¹M)⁻¹,

and needs no run of the model. p(h|y) is sampled by importance from Student's t about the mode (Kennedy & O'Hagan 2001;
nested Laplace approximations: Rue, Martino & Chopin 2009, J. R. Stat. Soc. B 71, 319).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from en4dvar.data.noise import BoundNoise, DiscrepancyNoise, Linearisation, Predicted, sides_of
from en4dvar.descent.weight_space import WeightSpace
from en4dvar.ensemble.forecast import of_framework
from en4dvar.ensemble.linalg import effective_number, resampled, shares_of, with_moments
from en4dvar.model.state import NOISE_SCALE, Array, Mask
from en4dvar.priors.parameter_map import QUANTILE_MAPS
from en4dvar.priors.prior import PriorTerm, member_stream
from en4dvar.problem import InverseProblem

DRAWS, FREEDOM = 1500, 5.0  # of Student's t
WIDER = 1.3  # than the Gaussian at the mode
AT_ONCE = 50
ENOUGH = 60.0  # effective draws below which the ensemble stays as it is
PARTICLES, SWEEPS = 2000, 40  # that bounds are imposed on; moves of each in the end
STENCIL = 0.02  # width of differences, in prior standard deviations


def marginal_members(space: WeightSpace, linear: Linearisation, mode: Array, posterior: Array) -> Array:
    """Members (N, n), transformed, in place of ``posterior`` (N, n), the Gaussian about the ``mode`` (n,)."""
    problem, prior = space.problem, space.problem.prior
    of_errors = np.array([name in problem.of_errors for name in prior.names])
    if not np.any([p.name in prior.names for p in problem.discrepancy]):
        return posterior
    z_mode = prior.white(mode)
    stream = member_stream(space.seed, "discrepancy")
    covariance = prior.white_covariance(np.atleast_2d(np.cov(posterior.T)))
    root = WIDER * np.linalg.cholesky(covariance[np.ix_(of_errors, of_errors)])
    normal = stream.standard_normal((DRAWS, len(root))) / np.sqrt(stream.chisquare(FREEDOM, (DRAWS, 1)) / FREEDOM)
    draws = z_mode[of_errors] + normal @ root.T
    log_proposal = -0.5 * (FREEDOM + len(root)) * np.log1p(np.sum(normal**2, axis=1) / FREEDOM)
    log_marginal, means, covariances = _given(space, linear, mode, of_errors, draws)
    logs = log_marginal - log_proposal
    weights = shares_of(np.where(np.isnan(logs), -np.inf, logs))
    if effective_number(weights) < ENOUGH:
        return posterior
    # members (N, n) of the mixture, in units of the prior: systematic in h, random in u
    chosen = resampled(weights, len(posterior), stream)
    normal = stream.standard_normal((len(posterior), means.shape[1]))
    members = np.empty((len(posterior), len(of_errors)))
    members[:, of_errors] = draws[chosen]
    members[:, ~of_errors] = means[chosen] + np.einsum("dij,dj->di", np.linalg.cholesky(covariances[chosen]), normal)
    if space.settings.sampling == "exact":
        # The members mapped linearly so that mean and covariance are those of the whole mixture
        centres = np.empty((len(draws), len(of_errors)))
        centres[:, of_errors], centres[:, ~of_errors] = draws, means
        mean = weights @ centres
        target = (weights[:, None] * (centres - mean)).T @ (centres - mean)
        target[np.ix_(~of_errors, ~of_errors)] += np.einsum("d,dij->ij", weights, covariances)
        members = with_moments(members, mean, target)
    return prior.from_white(members)


def _given(
    space: WeightSpace, linear: Linearisation, mode: Array, of_errors: Mask, draws: Array
) -> tuple[Array, Array, Array]:
    """ln p(h|y) (D,) up to a constant, and mean (D, n') and covariance (D, n', n') of u, for draws of h (D, n'')."""
    prior, observations = space.problem.prior, space.problem.observations
    noise = observations.noise
    assert isinstance(noise, DiscrepancyNoise)
    at, beta = linear.prediction, float(observations.weights[0])
    noise = noise.gaussian_at(observations.values, at)
    to_control = np.ascontiguousarray(prior.white_change((space.anomalies.T @ space.basis).T).T)
    slopes = (linear.anomalies.T @ np.linalg.pinv(to_control))[:, ~of_errors]
    rest = prior.white(mode)[~of_errors]
    columns = np.column_stack([observations.values - at.values + slopes @ rest, slopes])
    x = np.tile(mode, (len(draws), 1))
    x[:, of_errors] = prior.mean[of_errors] + prior.std[of_errors] * draws
    problem, physical, count = space.problem, prior.to_physical(x), len(draws)
    predicted = Predicted(
        np.tile(at.values, (count, 1)),
        None if at.rates is None else np.tile(at.rates, (count, 1)),
        of_framework(problem, physical, NOISE_SCALE, 1.0) if problem.has_noise_scale else None,
        np.stack([of_framework(problem, physical, p, 1.0) for p in problem.discrepancy], axis=1),
    )
    log_density, means, covariances = [], [], []
    for first in range(0, len(draws), AT_ONCE):
        white, roots = noise.whitened_columns(columns, predicted[first : first + AT_ONCE])
        products = beta * np.einsum("dki,dkj->dij", white, white, optimize=True)
        impossible = ~np.isfinite(products).all(axis=(1, 2))
        products[impossible] = 0.0
        information = np.eye(slopes.shape[1]) + products[:, 1:, 1:]
        inverse = np.linalg.inv(information)
        mean = np.einsum("dij,dj->di", inverse, products[:, 1:, 0])
        squares = products[:, 0, 0] - np.einsum("di,di->d", products[:, 0, 1:], mean)
        dets = 2 * np.log(roots).sum(axis=1) + np.linalg.slogdet(information)[1]
        log_density.append(np.where(impossible, -np.inf, -0.5 * (squares + dets)))
        means.append(mean)
        covariances.append(inverse)
    log_prior = -0.5 * np.sum(draws**2, axis=1)
    return np.concatenate(log_density) + log_prior, np.concatenate(means), np.concatenate(covariances)


@dataclass(frozen=True)
class Drawn:
    """``members`` (N, n), transformed, of a posterior that is no Gaussian; ``cost``, J (B,) of control vectors (B, n)
    as far as predictions are linear about the mode, and ln p(y), ``log_evidence``, so far, but for the errors'
    normalisation.
    """

    members: Array
    cost: Callable[[Array], Array]
    log_evidence: float


def beside_bounds(space: WeightSpace, linear: Linearisation, w: Array, cost: float) -> Drawn | None:
    """The posterior about its mode, of weights w (N,) and J ``cost``, where readings are bounds: the Gaussian of all
    else, cut off softly. None where none is.

    About a minimum of J the curvature of a bound is that of a Gaussian on one side and zero on the other, so no
    Gaussian is near. With the predictions linear about it, all but the bounds is a Gaussian in closed form; from its
    draws the bounds are imposed by degrees (sequential Monte Carlo: Del Moral, Doucet & Jasra 2006, J. R. Stat. Soc. B
    68, 411), with elliptical slice sampling (Murray, Adams & MacKay 2010, AISTATS 9, 541), which needs no run of the
    model.
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

    stream, mode = member_stream(space.seed, "bounds"), (root @ -middle)[None]
    lowest = cost - float(of_bounds(mode)[0]) - 0.5 * float(np.sum(mode**2))  # J of all else at its own minimum
    z, log_share = _imposed(stream.standard_normal((max(PARTICLES, n_members), r)), of_bounds, stream)
    z = z[:n_members]
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


def mean_beyond_mode(problem: InverseProblem, mode: Array, posterior: Array, dfs: float) -> Array:
    r"""What to add to the ``mode`` (n,) for the mean (n,); zero without a noise scale, or beside a discrepancy,
    where all parameters of the errors are marginalised (:func:`marginal_members`).

    ``posterior`` (N, n) are members whose covariance is C, ``dfs`` = tr (M + U) C; all in transformed space.

    With u = ln σ, v = (y − m)/s and ψ = ρ' the third derivatives of J_o with respect to u and any two directions do not
    vanish on average: a fit uses up degrees of freedom, so that J prefers too small a σ. In the notation of
    :mod:`en4dvar.data.noise`, with the information M = SᵀS of the predictions and U of ln σ, their expectations under
    exp(−ρ) are

        ∂²_m ∂_u J = −r_m M,   r_m = E[2ψ' + vψ''] / E[ψ/v],
        ∂³_u J = −r_u U,       r_u = E[vψ + 3v²ψ' + v³ψ''] / E[vψ + v²ψ'],

    both 2 where errors are Gaussian. For u = g(x), x the coordinate that is estimated, C = A⁻¹, the mean of any
    coordinate lies −½ C tr(C ∇³J) beyond the mode (Tierney & Kadane 1986, J. Am. Stat. Assoc. 81, 82):

        ½ C e_x [ g' (r_m tr MC + r_u tr UC) − 3 (g''/g') tr UC − g''' ∂_u J C_xx ].
    """
    prior, name = problem.prior, NOISE_SCALE.name
    if name not in prior.names or not problem.has_noise_scale or problem.discrepancy:
        return np.zeros(len(mode))
    column = prior.names.index(name)
    anomalies = posterior - posterior.mean(axis=0)
    covariance = anomalies.T @ anomalies[:, column] / (len(posterior) - 1)
    term, x, variance = prior.terms[column], float(mode[column]), float(covariance[column])
    first, second, third = log_derivatives(term, x)
    ratio = problem.observations.noise.scale_skewness()
    of_scale = float(problem.observations.weights.sum()) * ratio.information * first**2 * variance
    slope = -(x - term.mean) / term.std**2 / first  # of J_o in u: the mode balances it against the prior
    skewness = (
        first * (ratio.of_predictions * (dfs - of_scale) + ratio.of_scale * of_scale)
        - 3 * second / first * of_scale
        - third * slope * variance
    )
    return np.asarray(0.5 * covariance * skewness)


def log_derivatives(term: PriorTerm, x: float) -> tuple[float, float, float]:
    """Derivatives g', g'', g''' of u = ln σ in the transformed coordinate at ``x``."""
    if term.transform == "lognormal":
        return 1.0, 0.0, 0.0
    if term.transform in QUANTILE_MAPS:
        # The same by central differences over seven points
        h, u = STENCIL, np.log(term.to_physical(x + STENCIL * np.arange(-3.0, 4.0)))
        first = np.dot([-1, 9, -45, 0, 45, -9, 1], u) / (60 * h)
        second = np.dot([2, -27, 270, -490, 270, -27, 2], u) / (180 * h**2)
        return float(first), float(second), float(np.dot([1, -8, 13, 0, -13, 8, -1], u) / (8 * h**3))
    sigma = float(term.to_physical(np.array(x)))
    slopes = 1.0, 0.0, 0.0
    if term.transform == "logit":
        low, high = term.bounds
        share = (sigma - low) / (high - low)
        slope = (high - low) * share * (1 - share)
        slopes = slope, slope * (1 - 2 * share), slope * (1 - 6 * share + 6 * share**2)
    a, b, c = (slope / sigma for slope in slopes)
    return a, b - a**2, c - 3 * a * b + 2 * a**3
