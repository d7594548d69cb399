r"""The posterior beside an estimated discrepancy: a mixture over amplitude, length and noise scale.

At the mode of J these are too small, for a fit uses up degrees of freedom, and a posterior at one value of them is too
narrow. With the predictions linear about the mode, m(u) = m(0) + M u in the other coordinates u ~ N(0, I), all that
depends on the parameters h of the covariance K(h) is known in closed form,

    p(h|y) ∝ N(y − m(0); 0, K + M Mᵀ) p(h),   u | h ~ N(P MᵀK⁻¹(y − m(0)), P),   P = (I + MᵀK⁻¹M)⁻¹,

and needs no run of the model. p(h|y) is sampled by importance from Student's t about the mode (Kennedy & O'Hagan 2001;
nested Laplace approximations: Rue, Martino & Chopin 2009, J. R. Stat. Soc. B 71, 319).
"""

import numpy as np
import numpy.typing as npt

from en4dvar.data.noise import DiscrepancyNoise, Linearisation, Predicted
from en4dvar.descent.weight_space import WeightSpace
from en4dvar.ensemble.forecast import of_framework
from en4dvar.ensemble.linalg import with_moments
from en4dvar.model.state import NOISE_SCALE, Array
from en4dvar.priors.prior import member_stream

Mask = npt.NDArray[np.bool_]
DRAWS, FREEDOM = 1500, 5.0  # of Student's t
WIDER = 1.3  # than the Gaussian at the mode
AT_ONCE = 250
ENOUGH = 60.0  # effective draws below which the ensemble stays as it is


def marginal_members(space: WeightSpace, linear: Linearisation, mode: Array, posterior: Array, seed: int) -> Array:
    """Members (N, n), transformed, in place of ``posterior`` (N, n), the Gaussian about the ``mode`` (n,)."""
    problem, prior = space.problem, space.problem.prior
    of_errors = np.array([name in problem.of_errors for name in prior.names])
    if not np.any([p.name in prior.names for p in problem.discrepancy]):
        return posterior
    z_mode = prior.white(mode)
    stream = member_stream(seed, "discrepancy")
    covariance = prior.white_covariance(np.atleast_2d(np.cov(posterior.T)))
    root = WIDER * np.linalg.cholesky(covariance[np.ix_(of_errors, of_errors)])
    normal = stream.standard_normal((DRAWS, len(root))) / np.sqrt(stream.chisquare(FREEDOM, (DRAWS, 1)) / FREEDOM)
    draws = z_mode[of_errors] + normal @ root.T
    log_proposal = -0.5 * (FREEDOM + len(root)) * np.log1p(np.sum(normal**2, axis=1) / FREEDOM)
    log_marginal, means, covariances = _given(space, linear, mode, of_errors, draws)
    log_weights = log_marginal - log_proposal
    weights = np.exp(log_weights - np.nanmax(log_weights))
    weights = np.where(np.isfinite(weights), weights, 0.0)
    weights /= weights.sum()
    if 1 / np.sum(weights**2) < ENOUGH:
        return posterior
    # members (N, n) of the mixture, in units of the prior: systematic in h, random in u
    places = (np.arange(len(posterior)) + stream.random()) / len(posterior)
    chosen = np.minimum(np.searchsorted(np.cumsum(weights), places), len(weights) - 1)
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
        covariance = noise.covariance(predicted[first : first + AT_ONCE]) / beta
        solved = np.linalg.solve(covariance, np.broadcast_to(columns, (len(covariance), *columns.shape)))
        products = columns.T @ solved
        information = np.eye(slopes.shape[1]) + products[:, 1:, 1:]
        inverse = np.linalg.inv(information)
        mean = np.einsum("dij,dj->di", inverse, products[:, 1:, 0])
        squares = products[:, 0, 0] - np.einsum("di,di->d", products[:, 0, 1:], mean)
        dets = np.linalg.slogdet(covariance)[1] + np.linalg.slogdet(information)[1]
        log_density.append(-0.5 * (squares + dets))
        means.append(mean)
        covariances.append(inverse)
    log_prior = -0.5 * np.sum(draws**2, axis=1)
    return np.concatenate(log_density) + log_prior, np.concatenate(means), np.concatenate(covariances)
