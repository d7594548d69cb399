r"""Observation errors: kinds of R, which may depend on the state, and the whitening that hides this from schemes.

With prediction m, its rate ṁ, value error std, timing error τ and noise scale σ the errors are R = D C D with

    D = diag(s),   s = σ √(std² + (ṁ τ)²),   z = (y−m)/s,   v = L⁻¹z,   C = L Lᵀ,
    J_o = Σ_k β_k [ ρ(v_k) + ln(s_k/std_k) ],   ρ(v) = ½ v², or Huber's function.

Where the path is known between the readings, ṁ is its standard deviation over the uncertain instant, divided by that
of the instant (:mod:`en4dvar.ensemble.forecast`); of a straight path that is |ṁ|.

Where τ ≠ 0 or σ is estimated the variance depends on the control vector. The score and the Fisher information of the
errors are those of linear least squares in the augmented whitened arrays

    d = √β [ L⁻¹z ;  B⁻¹(z∘C⁻¹z − 1) ],      S = √β [ L⁻¹ ∂m/s ;  Bᵀ ∂ln s ],      B Bᵀ = I + C∘C⁻¹,

that is ∇J_o = −Sᵀd exactly and E[∇²J_o] = SᵀS, so a scheme written for constant R performs Fisher scoring unchanged:
½ tr(R⁻¹∂R R⁻¹∂R) with ∂R = UR + RU, U = diag(∂ln s), is ∂ln sᵀ (I + C∘C⁻¹) ∂ln s. For C = 1 it is B = √2.

Huber (1981), Robust Statistics, § 4.5: ρ(v) = ½ v² for |v| ≤ c, c|v| − ½c² beyond, the negative logarithm of a density
whose tails are exponential. Its rows of d and S take the weights min(1, c/|v|) (iteratively reweighted least squares):
the gradient is exact, SᵀS bounds the Hessian of the part of m from above.

A kind of errors is one class of this folder: :class:`Noise` is Gaussian and independent, the others say what differs.
Several series are blocks, joined where they are correlated (:mod:`en4dvar.data.noise.make`). What readings share makes
C a diagonal plus low rank, and errors that decay exponentially are a Markov process: both are whitened without any
matrix (:class:`SharedErrors`, :class:`DecayingErrors`).
A discrepancy of the model (:mod:`en4dvar.data.noise.discrepancy`) adds a Gaussian process to any of them.
"""

from en4dvar.data.noise.correlated import (
    DECAY,
    SHARED,
    CorrelatedNoise,
    Correlation,
    DecayingErrors,
    SharedErrors,
    recorded,
)  # fmt: skip
from en4dvar.data.noise.discrepancy import SMOOTHNESS, DiscrepancyNoise, Kernel, RobustDiscrepancyNoise
from en4dvar.data.noise.gaussian import Linearisation, Noise, Predicted
from en4dvar.data.noise.losses import SIDES, BoundNoise, HuberNoise, sides_of
from en4dvar.data.noise.make import BlockNoise, joint_noise, noise_of, noise_of_readings, noise_of_record

__all__ = [
    "DECAY", "SHARED", "SIDES", "SMOOTHNESS", "BlockNoise", "BoundNoise", "CorrelatedNoise", "Correlation",
    "DecayingErrors", "DiscrepancyNoise", "HuberNoise", "Kernel", "Linearisation", "Noise", "Predicted",
    "RobustDiscrepancyNoise", "SharedErrors", "joint_noise", "noise_of", "noise_of_readings",
    "noise_of_record", "recorded", "sides_of",
]  # fmt: skip
