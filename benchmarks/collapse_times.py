"""One gel from the first collapse times of many bubbles, beside the published method (Zhu et al. 2025).

    python benchmarks/collapse_times.py [FILE.mat ...]      default: the two campaigns of ../shared/data
    python benchmarks/collapse_times.py --least-squares     how far each gas is from the times, radii as they stand

A file holds ``pIMR_array`` (n, 3): R_max (m), R_max/R_eq, first collapse time (s). G and μ are common to all bubbles;
what is known of a bubble, R_max and R_eq, enters with an error of its own, and so does its collapse time.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.io import loadmat
from scipy.optimize import least_squares, minimize
from scipy.special import gamma

from en4dvar.data.noise import noise_of
from en4dvar.data.observations import Observations
from en4dvar.ensemble.forecast import forecast
from en4dvar.estimation.joint import JointEstimate, estimate_jointly, sharing
from en4dvar.estimation.joint.estimate import Single
from en4dvar.model.state import Array
from en4dvar.priors.prior import Prior, PriorTerm
from en4dvar.problem import InverseProblem
from en4dvar.schemes.settings import AssimilationSettings
from en4dvar_bubble import BubbleModel, NeoHookeanKelvinVoigt
from en4dvar_bubble.medium import WATER_25C

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
# Errors of radii and times, and the gas. A simulation has the errors of its integration alone; in its authors' code
# (github.com/zhirenruns/runIMR) heat and vapour diffuse in the bubble.
CAMPAIGNS = {
    "LHS-simpool-x36_KV.mat": (1e-5, 2e-9, "vapour"),
    "pIMR_PA_10_Refined.mat": (0.005, 20e-9, "polytropic"),
}
P_INF, RHO, S, C, P_V = 101325.0, 998.2, 0.070, 1484.0, 3116.7757  # of the published code
MEDIUM = replace(WATER_25C, p_inf=P_INF, rho=RHO, S=S, c=C, B=1.17e-2)
GASES = {
    "polytropic": {"gas": "polytropic", "medium": replace(MEDIUM, p_v=P_V)},
    "heat": {"gas": "heat", "medium": replace(MEDIUM, p_v=P_V)},
    "vapour": {"gas": "heat", "vapour": "transport", "medium": MEDIUM},
}
PRIOR = {"G": (5e3, 1.5), "mu": (0.05, 1.2)}  # median, log_std
SETTINGS = AssimilationSettings(what_if=False)


def model_of(gas: str) -> BubbleModel:
    """Neo-Hookean, with a gas of :data:`GASES`."""
    return BubbleModel(law=NeoHookeanKelvinVoigt(), start="laser", **GASES[gas])


def problems_of(campaign: Array, radius_error: float, time_error: float, model: BubbleModel) -> list[InverseProblem]:
    """A problem a bubble: one reading, its collapse time; ``radius_error`` relative, of R_max and of R_eq each."""
    parameters = {p.name: p for p in model.parameters}
    observable = next(one for one in model.observables if one.name == "collapse_time")
    common = tuple(PriorTerm.lognormal(parameters[name], *about) for name, about in PRIOR.items())
    problems = []
    for i, (R_max, ratio, t_c) in enumerate(campaign):
        own = tuple(
            PriorTerm.lognormal(parameters[name], value, radius_error)
            for name, value in (("R_max", R_max), ("R_eq", R_max / ratio))
        )
        one = np.ones(1)
        observed = Observations(t_c * one, t_c * one, noise_of(time_error * one, 0 * one), one, name=f"bubble{i:02d}")
        problems.append(InverseProblem(model, observable, observed, Prior((*common, *own))))
    return problems


def one_gel(
    campaign: Array, radius_error: float, time_error: float, gas: str = "polytropic", seed: int = 1
) -> JointEstimate:
    """G and μ common to all bubbles. The descents start at the prior: a single time tells G or μ, never both."""
    problems = problems_of(campaign, radius_error, time_error, model_of(gas))
    alone = [Single(np.zeros(4), 1.001 * np.eye(4)) for _ in problems]
    return estimate_jointly(sharing(problems, ["G", "mu"]), SETTINGS, seed, singles=alone)


def least_squares_of(campaign: Array, gas: str) -> tuple[float, float, float]:
    """G (Pa), μ (Pa s) that meet the collapse times best with the radii as they stand, and the root mean square (s)."""
    problems = problems_of(campaign, 1.0, 1.0, model_of(gas))
    own = np.stack([problem.prior.mean for problem in problems])

    def left(theta: Array) -> Array:
        own[:, :2] = theta
        times = [forecast(problem, x[None]).predictions[0, 0] for problem, x in zip(problems, own, strict=True)]
        return (np.array(times) - campaign[:, 2]) / 1e-9

    best = least_squares(left, np.log([1e4, 0.1]), diff_step=1e-4)
    return *map(float, np.exp(best.x)), float(1e-9 * np.sqrt(np.mean(best.fun**2)))


def tell_least_squares(file: Path, every: int) -> None:
    """A line for every gas."""
    campaign = loadmat(file)["pIMR_array"][::every]
    for gas in GASES:
        G, mu, error = least_squares_of(campaign, gas)
        found = f"G {G / 1e3:.3f} kPa, mu {mu:.4f} Pa s, {1e9 * error:.1f} ns"
        print(f"{file.name}, {len(campaign)} bubbles, gas {gas}: {found}")


def published(campaign: Array) -> tuple[float, float, float]:
    """G (Pa), μ (Pa s) of the energy balance of Zhu et al. (2025), and the root mean square of (t/t_model)² − 1."""
    R_max, ratio, t_c = campaign.T
    arc = 1 / (np.sqrt(np.pi / 6) * gamma(5 / 6) / gamma(4 / 3))
    speed = np.sqrt(P_INF / RHO)
    compressible = 2 / np.sqrt(2 + 4 * (C / speed / arc) ** 2)
    tension = -np.pi * arc / (np.sqrt(6) * P_INF * R_max / (2 * S))
    gas = 1.4942 * ratio**-3 * (1 + P_V / (P_INF * ratio**-3))

    def squared(theta: Array) -> float:
        G, mu = np.exp(theta)
        elastic = 1 / (1 + (2.5 - np.sqrt(2 / 3) * np.pi * arc / ratio) * G / P_INF)
        viscous = mu / (RHO * speed * R_max)
        z = elastic * 2 * arc * (0.4637 * viscous + 0.56598 * viscous**2 + 5.7331 * viscous**3)
        rate = (z + np.sqrt(z**2 + elastic)) ** -2 - tension - compressible - gas
        if rate.min() <= 0:
            return np.inf
        return float(np.mean(((t_c * speed * arc / R_max) ** 2 * rate - 1) ** 2))

    best = minimize(squared, np.log([1e4, 0.1]), method="Nelder-Mead", options={"xatol": 1e-6, "fatol": 1e-14})
    return *map(float, np.exp(best.x)), float(np.sqrt(best.fun))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="*", type=Path, default=[DATA / name for name in CAMPAIGNS])
    parser.add_argument("--radius-error", type=float)
    parser.add_argument("--time-error", type=float)
    parser.add_argument("--every", type=int, default=1, help="take every n-th bubble")
    parser.add_argument("--gas", choices=tuple(GASES))
    parser.add_argument("--least-squares", action="store_true")
    asked = parser.parse_args()
    if asked.least_squares:
        for file in asked.files:
            tell_least_squares(file, asked.every)
        return
    print("| campaign | bubbles | | G (kPa) | mu (Pa s) | chi2 a reading |")
    print("|---|---|---|---|---|---|")
    for file in asked.files:
        campaign = loadmat(file)["pIMR_array"][:: asked.every]
        radius_error, time_error, gas = CAMPAIGNS.get(file.name, (0.005, 20e-9, "polytropic"))
        radius_error, time_error = asked.radius_error or radius_error, asked.time_error or time_error
        gas = asked.gas or gas
        (first,) = problems_of(campaign[:1], radius_error, time_error, model_of(gas))
        forecast(first, first.prior.mean[None])  # compiled, which is not what is timed
        began = time.process_time()
        found = one_gel(campaign, radius_error, time_error, gas)
        spent = time.process_time() - began
        mean, std = found.shared.mean(axis=0), found.shared.std(axis=0, ddof=1)
        cells = f"{mean[0] / 1e3:.3f} ± {std[0] / 1e3:.3f} | {mean[1]:.4f} ± {std[1]:.4f} | {misfit(found):.2f}"
        how = f"here, gas: {gas}, {spent:.0f} s of CPU, {found.forward_runs} runs"
        print(f"| {file.name} | {len(campaign)} | {how} | {cells} |", flush=True)
        G, mu, error = published(campaign)
        print(f"| | | energy balance | {G / 1e3:.2f} | {mu:.4f} | (t/t_model)² − 1: {error:.4f} |")
        for one in found.cautions:
            print(one)


def misfit(found: JointEstimate) -> float:
    """2 J_o and what the bubbles' own quantities paid, over the readings that are left beyond G and μ."""
    own = sum(float(v @ v) for v in found.mode.own)
    return (float(found.chi2.sum()) + own) / (len(found.chi2) - 2)


if __name__ == "__main__":
    main()
