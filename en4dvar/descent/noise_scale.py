r"""How far the posterior mean lies beyond the mode where the noise scale σ is estimated.

With u = ln σ, v = (y − m)/s and ψ = ρ' the third derivatives of J_o with respect to u and any two directions do not
vanish on average: a fit uses up degrees of freedom, so that J prefers too small a σ. In the notation of
:mod:`en4dvar.data.noise`, with the information M = SᵀS of the predictions and U of ln σ, their expectations under
exp(−ρ) are

    ∂²_m ∂_u J = −r_m M,   r_m = E[2ψ' + vψ''] / E[ψ/v],
    ∂³_u J = −r_u U,       r_u = E[vψ + 3v²ψ' + v³ψ''] / E[vψ + v²ψ'],

both 2 where errors are Gaussian. For u = g(x), x the coordinate that is estimated, C = A⁻¹, the mean of any coordinate
lies −½ C tr(C ∇³J) beyond the mode (Tierney & Kadane 1986, J. Am. Stat. Assoc. 81, 82):

    ½ C e_x [ g' (r_m tr MC + r_u tr UC) − 3 (g''/g') tr UC − g''' ∂_u J C_xx ].
"""

import numpy as np

from en4dvar.model.state import NOISE_SCALE, Array
from en4dvar.priors.parameter_map import QUANTILE_MAPS
from en4dvar.priors.prior import PriorTerm
from en4dvar.problem import InverseProblem

STENCIL = 0.02  # width of differences, in prior standard deviations


def mean_beyond_mode(problem: InverseProblem, mode: Array, posterior: Array, dfs: float) -> Array:
    """What to add to the ``mode`` (n,) for the mean (n,); zero without a noise scale, or beside a discrepancy,
    where all parameters of the errors are marginalised (:mod:`en4dvar.descent.marginal`).

    ``posterior`` (N, n) are members whose covariance is C, ``dfs`` = tr (M + U) C; all in transformed space.
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
