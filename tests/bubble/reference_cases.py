"""The cases of ``laser.npz`` and ``imr_suite.npz`` in the terms of this project and of ``suite_oracle``."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from suite_oracle import M_G, M_V, p_sat

from en4dvar_bubble import WATER_25C, Accuracy, BubbleModel, Medium, get_law, simulate

ACCURATE = Accuracy(nodes=24, medium_nodes=48, rtol=1e-7)
LASER = {"G": 2770.0, "mu": 0.186, "R_max": 230e-6, "R_eq": 230e-6 / 7}
A_V, B_V = 3.30e-5, 1.742e-2  # conductivity of the vapour in the suite: W/(m K²), W/(m K)
NEO_HOOKEAN = "neo-hookean-kelvin-voigt"
RADIAL = {1: "rayleigh-plesset", 2: "keller-miksis", 3: "keller-miksis-enthalpy", 4: "gilmore"}
LAW = {0: "newtonian", 1: NEO_HOOKEAN, 2: "quadratic-kelvin-voigt", 5: "upper-convected-maxwell"}


def first_rebound(t, R):
    """(radius, instant) of the first maximum after the first collapse of a released bubble, by a parabola."""
    i = np.flatnonzero((R[1:-1] < R[:-2]) & (R[1:-1] <= R[2:]))[0]
    k = i + 1 + np.argmax(R[i + 1 : i + 1 + len(R) // 3])
    a, b, c = np.polyfit(t[k - 1 : k + 2] - t[k], R[k - 1 : k + 2], 2)
    return c - b * b / (4 * a), t[k] - b / (2 * a)


def initial_mass_fraction(vapour, gas):
    """Mass fraction of vapour at the partial pressures ``vapour`` and ``gas``."""
    return 1 / (1 + M_G / M_V * gas / vapour)


def averaged(medium, fraction, A_v=A_V, B_v=B_V):
    """The conductivity that the public codes use: of gas and vapour, averaged at a mass fraction of vapour."""
    return replace(
        medium,
        A=fraction * A_v + (1 - fraction) * medium.A,
        B=fraction * B_v + (1 - fraction) * medium.B,
    )


def laser_case(case):
    """Options of :func:`simulate` for a case of ``laser.npz``."""
    vapour = ("none", "frozen", "frozen", "transport")[case]
    medium = WATER_25C
    if vapour == "frozen":
        pv = p_sat(medium.T_inf)
        gas = (medium.p_inf + 2 * medium.S / LASER["R_eq"] - pv) * (LASER["R_eq"] / LASER["R_max"]) ** 3
        medium = averaged(medium, initial_mass_fraction(pv, gas))
    return {"vapour": vapour, "medium_heat": "conducting" if case >= 2 else "cold", "medium": medium}


def laser(case, times, accuracy=ACCURATE):
    """R (K,) of a case of ``laser.npz``."""
    data = simulate(NEO_HOOKEAN, LASER, times, start="laser", accuracy=accuracy, **laser_case(case))
    return data.R[0].values


def laser_as_suite_case():
    """Case 3 of ``laser.npz`` for ``suite_oracle``."""
    m = WATER_25C
    gas = (m.p_inf + 2 * m.S / LASER["R_eq"] - p_sat(m.T_inf)) * (LASER["R_eq"] / LASER["R_max"]) ** 3
    return {
        "radial": 2, "stress": 1, "bubtherm": 1, "medtherm": 1, "masstrans": 1, "vapor": 1,
        "R0": LASER["R_max"], "Req": LASER["R_eq"], "mu": LASER["mu"], "G": LASER["G"], "alphax": 0.0,
        "lambda1": 1e-7, "lambda2": 0.0, "P0_gas": gas, "P8": m.p_inf, "rho8": m.rho, "C8": m.c, "GAM": m.tait_B,
        "nstate": m.tait_n, "surft": m.S, "kappa": m.kappa, "T8": m.T_inf, "ATg": m.A, "BTg": m.B, "ATv": A_V,
        "BTv": B_V, "Km": m.K_m, "Cp": m.c_m, "D": m.D_v, "L": m.L_v,
    }  # fmt: skip


def stored(z, i):
    """Case ``i`` of ``imr_suite.npz``: column → number."""
    n = len(z["radial"])
    return {k: z[k][i].item() for k in z.files if z[k].shape == (n,)}


def suite(c, times, accuracy=ACCURATE):
    """R/R0 (K,) of a stored case by this project.

    The initial pressure of the gas is the stored one (polytropic cases hold p_eq (R_eq/R0)^{3κ}), so it is written
    into the state. Gilmore's cases take the sound speed of the Tait equation, as the suite does.
    """
    pv = c["vapor"] * p_sat(c["T8"])
    medium = Medium(
        rho=c["rho8"], c=c["C8"], p_inf=c["P8"], S=c["surft"], T_inf=c["T8"], kappa=c["kappa"], A=c["ATg"], B=c["BTg"],
        K_m=c["Km"], c_m=c["Cp"], tait_B=c["GAM"], tait_n=c["nstate"],
    )  # fmt: skip
    if c["radial"] == 4:
        medium = replace(medium, c=float(np.sqrt(c["nstate"] * (c["P8"] + c["GAM"]) / c["rho8"])))
    heat = bool(c["bubtherm"])
    medium = (
        averaged(medium, initial_mass_fraction(pv, c["P0_gas"]), c["ATv"], c["BTv"])
        if heat
        else replace(medium, p_v=pv)
    )
    model = BubbleModel(
        law=get_law(LAW[c["stress"]]),
        start="laser",
        gas="heat" if heat else "polytropic",
        vapour="frozen" if heat else "none",
        medium_heat="conducting" if c["medtherm"] else "cold",
        radial=RADIAL[c["radial"]],
        medium=medium,
        accuracy=accuracy,
    )
    values = {"G": c["G"], "alpha": c["alphax"], "mu": c["mu"], "mu_p": c["mu"], "relaxation_time": c["lambda1"]}
    values |= {"R_max": c["R0"], "R_eq": c["Req"]}
    if c["stress"] == 0:
        values["mu"] = 0.0
    x = model.initial_states({p.name: np.array([values[p.name]]) for p in model.parameters})
    x[:, model.layout["p_b"]] = c["P0_gas"] + pv
    path = model.integrate(x, np.asarray(times)[None])
    assert path.solution.status[0] == 0, path.solution.reason(0)
    return path["R"][0] / c["R0"]
