"""Media by name: density and speed of sound of water, gels and solutions, and how well each is known.

The volumes of water and polymer add, 1/ρ = (1−w)/ρ_w + w v, and the speed of sound rises in proportion to the mass
fraction w, c = c_w + s w. A gel made elsewhere differs from that by ``rho_error`` and ``c_error``, by what swelling or
drying does as well; where nobody says how much polymer there is, the usual amount and its spread count too, and what
rheometry codes take (``rho_codes``). At 25 °C; c_w changes by 0.18 % a kelvin.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

_WATER = 997.05, 1496.7  # kg/m³: IAPWS-95; m/s: Del Grosso & Mader (1972), both at 25 °C


@dataclass(frozen=True)
class KnownMedium:
    """Medians ``rho`` (kg/m³) and ``c`` (m/s), standard deviations of their logarithms, and where all that is from."""

    rho: float
    c: float
    rho_log_std: float
    c_log_std: float
    source: str


@dataclass(frozen=True)
class _Kind:
    """``volume`` v of the dissolved polymer in m³/kg, ``rise`` s of the speed in m/s; ``usual`` mass fraction and its
    standard deviation; relative errors of ρ and c beyond that of the concentration. ``rho_codes``: relative error of ρ
    where only the name is known, which reaches the density that codes take for such gels.
    """

    volume: float
    rise: float
    usual: tuple[float, float]
    rho_error: float
    c_error: float
    source: str
    rho_codes: float = 0.0

    def at(self, fraction: float) -> tuple[float, float]:
        """ρ and c at a mass fraction."""
        rho, c = _WATER
        return 1 / ((1 - fraction) / rho + fraction * self.volume), c + self.rise * fraction


_LIKE_PHANTOM = (
    "speed: rise of the polyacrylamide–albumin phantom of Lafon et al. (2005), Ultrasound Med. Biol. 31, 1383"
)
_ADDED = "specific volumes of water and dry polymer added"
_KINDS: Mapping[str, _Kind] = MappingProxyType(
    {
        "water": _Kind(1e-3, 0.0, (0.0, 0.0), 1e-3, 5e-3, "IAPWS-95; Del Grosso & Mader (1972), 25 °C, within 3 K"),
        "polyacrylamide": _Kind(0.70e-3, 300.0, (0.10, 0.04), 0.006, 0.01, f"{_ADDED}; {_LIKE_PHANTOM}", 0.015),
        "polyacrylamide-alginate": _Kind(
            0.68e-3, 300.0, (0.14, 0.05), 0.006, 0.01, f"{_ADDED}; {_LIKE_PHANTOM}", 0.015
        ),
        "agarose": _Kind(0.63e-3, 300.0, (0.010, 0.007), 3e-3, 6e-3, f"{_ADDED}; {_LIKE_PHANTOM}"),
        "gelatin": _Kind(0.69e-3, 300.0, (0.08, 0.04), 5e-3, 0.01, f"{_ADDED}; {_LIKE_PHANTOM}"),
        "peg": _Kind(
            0.842e-3,
            450.0,
            (0.20, 0.12),
            3e-3,
            0.015,
            "density: PEG 3000 in water at 298.15 K to 30 %, 1012.0 at 10 % and 1047.5 at 30 %, J. Korean Chem. Soc. "
            "63 (2019), supplement S12; speed: about 4.5 m/s for each percent",
        ),
    }
)
MEDIA: tuple[str, ...] = tuple(_KINDS)
"""The names: gels by their polymer, ``peg`` is poly(ethylene glycol) in water."""


def known_medium(name: str, concentration: float | None = None) -> KnownMedium:
    """A medium of :data:`MEDIA` at a ``concentration`` (mass of polymer over that of the whole), or at the usual one.

    Raises
    ------
    KeyError: a name that is not in :data:`MEDIA`.
    """
    kind = _KINDS[name]
    fraction, spread = kind.usual if concentration is None else (concentration, 0.0)
    (rho, c), (rho_more, c_more) = kind.at(fraction), kind.at(fraction + spread)
    source, rho_error = f"{name}: {kind.source}", kind.rho_error
    if concentration is not None:
        source = f"{name} at {concentration:.3g} by mass: {kind.source}"
    elif kind.rho_codes:
        source, rho_error = f"{source} (rheometry codes: 1060 kg/m³)", kind.rho_codes
    return KnownMedium(
        rho, c, math.hypot(math.log(rho_more / rho), rho_error), math.hypot(math.log(c_more / c), kind.c_error), source
    )
