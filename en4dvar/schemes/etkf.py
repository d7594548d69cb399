"""ETKF: the ensemble transform Kalman filter, deterministic, with the symmetric square root.

One Gauss–Newton step from the prior at the time of the observations; nothing is iterated and no state is smoothed.

    w = A⁻¹ Sᵀ d,   T = √(N−1) A^{-1/2},   A = (N−1) I + SᵀS

Sources: Bishop, Etherton & Majumdar (2001), Mon. Wea. Rev. 129, 420; symmetric root: Hunt, Kostelich & Szunyogh (2007),
Physica D 230, 112.
"""

from dataclasses import dataclass
from typing import ClassVar

from en4dvar.schemes.base import Scheme


@dataclass(frozen=True)
class ETKF(Scheme):
    """The filter: a window without length, analysed once. Filters with another analysis say so in :meth:`advance`."""

    words: ClassVar[str] = "symmetric square root"
    on: ClassVar[tuple[str, ...]] = ("window", "series")
    filters: ClassVar[bool] = True
