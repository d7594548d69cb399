r"""Where the posterior variance of a parameter comes from: the errors of the readings, the discrepancy, the prior.

With coordinates c of the weights, predictions C c, K = R + A and the Hessian 𝓐 = (N−1) I + SᵀS, the minimum answers to
y − m by 𝓐⁻¹CᵀK⁻¹, so that the covariance 𝓐⁻¹ of a linear problem is the sum of three,

    𝓐⁻¹ [ CᵀK⁻¹R K⁻¹C + rows of the errors' own parameters ] 𝓐⁻¹,     𝓐⁻¹ CᵀK⁻¹A K⁻¹C 𝓐⁻¹,     (N−1) 𝓐⁻²,

each carried to the parameters by the prior anomalies.
"""

import numpy as np

from en4dvar.data.noise import DiscrepancyNoise, Linearisation
from en4dvar.descent.weight_space import WeightSpace
from en4dvar.model.state import Array


def shares_of_variance(space: WeightSpace, linear: Linearisation) -> Array:
    """(n, 3) shares of errors, discrepancy and prior in each parameter's variance, transformed; rows sum to 1."""
    observations = space.problem.observations
    noise = observations.noise
    assert isinstance(noise, DiscrepancyNoise)
    _, sensitivity = observations.whiten(linear)
    precision = len(space.members) - 1
    inverse = np.linalg.inv(precision * np.eye(sensitivity.shape[1]) + sensitivity.T @ sensitivity)
    gain = observations.precision_times(linear.prediction, linear.anomalies)  # β CᵀK⁻¹
    discrepancy = gain @ noise.covariance_of_discrepancy(linear.prediction) @ gain.T / observations.weights[0]
    errors = sensitivity.T @ sensitivity - discrepancy
    to_parameters = space.anomalies.T @ space.basis @ inverse
    parts = (errors, discrepancy, precision * np.eye(len(inverse)))
    variances = np.stack([np.einsum("ij,jk,ik->i", to_parameters, part, to_parameters) for part in parts], axis=1)
    return np.asarray(variances / variances.sum(axis=1, keepdims=True))
