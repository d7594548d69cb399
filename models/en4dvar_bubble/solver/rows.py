"""Rows of the kernel's parameter array, one column per member, and of the border of the general equations. Units: µm,
µs, pressures over the density (µm²/µs²).
"""

LOG_GAS = 0  # ln of the gas content: p R³⟨1/θ⟩ (heat; of the non-condensible gas with vapour) or p R^{3κ} (polytropic)
VAPOUR = 1  # constant vapour pressure added to the gas
AMBIENT = 2  # p_∞
SURFACE = 3  # 2S
VISCOSITY = 4  # ν = μ/ρ
INVERSE_C = 5  # 1/c; 0 for an incompressible liquid (Rayleigh–Plesset)
CONDUCTION = 6  # K_∞T_∞/ρ
KAPPA = 7  # ratio of specific heats, or the exponent of a polytropic gas
SLOPE = 8  # a = A T_∞/K_∞
LOG_R0 = 9  # ln of the stress-free radius
AMPLITUDE = 10  # factor of the driving table
TABLE = 11  # offset of the member's elastic table
# Read by the general equations only.
TAIT_B = 12  # stiffness B of the liquid
TAIT_N = 13  # exponent n
DIFFUSION = 14  # D of vapour in gas, µm²/µs
SATURATION = 15  # p_sat = SATURATION · exp(−SATURATION_T/θ_w)
SATURATION_T = 16
LATENT = 17  # L/(R_v T_∞) · D ρ/(K_∞T_∞), of p/ρ
MEDIUM_K = 18  # K_m/K_∞
MEDIUM_D = 19  # thermal diffusivity of the medium, µm²/µs
HEATING = 20  # 12/(c_p T_∞) of the medium, of ν V²
VISCOUS_TABLE = 21  # offset of the member's table of ν against ln(|V| in 1/s), or ln λ
DIFFUSION_P = 22  # exponents of D ∝ (p_∞/p)^… θ^…
DIFFUSION_T = 23
# Of the driving: t_ref = (t − PULSE_SHIFT) · PULSE_RATE is the time at which its table is read.
PULSE_SHIFT = 24
PULSE_RATE = 25
PULSE_TABLE = 26  # offset of the member's table
SMEARED = 27  # numerical diffusivity of the vapour over R |Ṙ|; see :mod:`integrate`
IMAGE = 28  # ±1/(2h) of a rigid or free plane at the distance h; 0: none
CROSSING = 29  # α √(R_v T_∞/2π), µm/µs: at which vapour crosses the wall; α is the accommodation coefficient
PARAMETERS = 30
# Three further rows for each memory variable: relaxation time (µs), convection, offset of its two tables.
MEMORY = PARAMETERS
PER_MEMORY = 3

# Readings of p_f, in the order of :data:`driving.base.Reading`.
INSTANTANEOUS, RETARDED, AS_PRINTED = 0, 1, 2
# Radial equations (Rayleigh–Plesset is Keller–Miksis in pressure with INVERSE_C = 0).
PRESSURE, ENTHALPY, GILMORE = 0, 1, 2

# The border of the general equations (:mod:`general`): the sums where there are such fields, then τ_w, memory, V, u.
SLOPE_SUM, CONTENT_SUM, VAPOUR_SUM = 0, 1, 2
SUMS = 3
# What the fields read of the border: E, π̇, V + π̇/3κ, D/R² without θ^b, Y_w, τ_w; of the medium
# V, D_m/R², 12νV²/(c_p T_∞), θ_w − 1
CONDUCT, RATE, DRIFT, DIFFUSE, GAS_WALL, TAU_WALL, FLOW, SPREAD, HEAT, HOT = range(10)
SHARED = 10
