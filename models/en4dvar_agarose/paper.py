"""Tables of Mancia et al. (2021), "Acoustic Cavitation Rheometry": tables 1 and 2, in the units it prints them.

Its agarose measurements are not public; nothing here enters an inference.
"""

from dataclasses import dataclass
from typing import Literal

Model = Literal["nh", "qs", "qlkv"]
Route = Literal["sweep", "en4dvar"]

LABELS: dict[Model, str] = {"nh": "NH", "qs": "QS QLKV", "qlkv": "Gen QLKV"}
NAMES: dict[Model, str] = {"nh": "neo-Hookean", "qs": "quasi-static QLKV", "qlkv": "general QLKV"}
ROUTES: dict[Route, str] = {"sweep": "IMR sweep", "en4dvar": "En4D-Var"}


@dataclass(frozen=True)
class Quantity:
    """A parameter as the tables print it: ``factor`` times the SI value."""

    name: str
    plain: str
    latex: str
    unit: str
    factor: float


QUANTITIES = (
    Quantity("G", "G", r"$G$", "kPa", 1e-3),
    Quantity("alpha", "α", r"$\alpha$", "10⁻²", 1e2),
    Quantity("mu", "μ", r"$\mu$", "Pa s", 1.0),
    Quantity("R0", "R₀", r"$R_0$", "µm", 1e6),
)

Printed = dict[str, tuple[float, float]]


# gel → model → quantity → (mean, standard deviation)
TABLE_1: dict[str, dict[Model, Printed]] = {
    "0.3 %": {
        "nh": {"G": (9.0, 0.62), "mu": (0.092, 0.031), "R0": (0.68, 0.45)},
        "qs": {"G": (0.38, 0.16), "alpha": (2.6, 1.2), "mu": (0.086, 0.023), "R0": (0.43, 0.38)},
        "qlkv": {"G": (0.42, 0.062), "alpha": (2.9, 1.1), "mu": (0.086, 0.024), "R0": (0.43, 0.31)},
    },
    "1 %": {
        "nh": {"G": (30.0, 3.8), "mu": (0.14, 0.025), "R0": (0.93, 0.66)},
        "qs": {"G": (7.2, 0.33), "alpha": (2.5, 0.62), "mu": (0.15, 0.022), "R0": (1.3, 0.49)},
        "qlkv": {"G": (6.9, 0.49), "alpha": (2.5, 0.77), "mu": (0.15, 0.026), "R0": (1.3, 0.44)},
    },
}
TABLE_2: dict[str, dict[Model, Printed]] = {
    "0.3 %": {
        "nh": {"G": (9.66, 0.55), "mu": (0.086, 0.028), "R0": (0.51, 0.07)},
        "qs": {"G": (0.38, 0.16), "alpha": (3.0, 0.1), "mu": (0.097, 0.026), "R0": (0.50, 0.03)},
        "qlkv": {"G": (0.50, 0.05), "alpha": (3.0, 0.3), "mu": (0.094, 0.026), "R0": (0.51, 0.06)},
    },
    "1 %": {
        "nh": {"G": (36.0, 3.57), "mu": (0.14, 0.031), "R0": (1.03, 0.04)},
        "qs": {"G": (7.2, 0.33), "alpha": (2.4, 0.15), "mu": (0.16, 0.038), "R0": (1.29, 0.06)},
        "qlkv": {"G": (7.7, 0.89), "alpha": (2.5, 0.12), "mu": (0.16, 0.036), "R0": (1.29, 0.05)},
    },
}
TABLES: dict[Route, dict[str, dict[Model, Printed]]] = {"sweep": TABLE_1, "en4dvar": TABLE_2}
