"""What a constitutive law is.

An author writes one class: its ``name``, its ``parameters`` and either the closed form of the stress integral,
:meth:`stress`, or W′(λ), :meth:`strain_energy_rate`. Both take the hoop stretch λ = R/R0 and return the same shape;
``p.G`` etc. broadcast against it. The law is tabulated per member over λ = e^−5 … e^10.5 before the compiled
integration starts, so its author writes plain NumPy and the kernel does not change.
"""

from __future__ import annotations

from collections.abc import Mapping
from difflib import get_close_matches
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np

from en4dvar.errors import ConfigError
from en4dvar.state import Array, Parameter
from en4dvar_bubble.laws.parameters import MU
from en4dvar_bubble.tables import Grid, evaluate, from_slopes, from_values

GRID = Grid(origin=-5.0, step=1 / 32, cells=496)
_LOG_STRETCH = GRID.nodes
_STRETCH = np.exp(_LOG_STRETCH)
_UNSTRETCHED = int(np.flatnonzero(_LOG_STRETCH == 0.0)[0])
# Interpolation of the removable 0/0 at λ = 1 from the four nodes on either side (eighth order).
_ACROSS = np.array([0.8, -0.4, 4 / 35, -1 / 70])

REGISTRY: dict[str, type[ConstitutiveLaw]] = {}


class ConstitutiveLaw:
    """Base class of constitutive laws; a subclass with a ``name`` registers itself.

    The stress integral is J = 2 ∫_R^∞ (τ_rr − τ_θθ)/r dr = J_e(λ) − 4μ Ṙ/R. For any incompressible isotropic solid
    dJ_e/dλ = −W′(λ)/(λ³ − 1), J_e(1) = 0, with W(λ) the strain energy of the equibiaxial stretch λ.
    """

    name: ClassVar[str] = ""
    title: ClassVar[str] = ""
    parameters: ClassVar[tuple[Parameter, ...]] = (MU,)

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if cls.name:
            REGISTRY[cls.name] = cls

    def stress(self, stretch: Array, p: Any) -> Array:
        """J_e(λ) in Pa: the elastic part of the stress integral."""
        raise NotImplementedError

    def strain_energy_rate(self, stretch: Array, p: Any) -> Array:
        """W′(λ) in Pa: derivative of the strain energy density in equibiaxial stretch."""
        raise NotImplementedError

    def table(self, values: Mapping[str, Array]) -> Array:
        """J_e against ln λ for N members: (N, cells, 8) coefficients on :data:`GRID`, Pa. ``values``: name → (N,)."""
        p = SimpleNamespace(**{name: np.asarray(v, dtype=float)[:, None] for name, v in values.items()})
        n = len(next(iter(values.values())))
        with np.errstate(all="ignore"):  # a law may overflow at stretches that no member reaches
            if type(self).stress is not ConstitutiveLaw.stress:
                samples = np.broadcast_to(self.stress(_STRETCH, p), (n, len(_STRETCH)))
                return np.asarray(from_values(np.ascontiguousarray(samples)))
            slopes = -_STRETCH * self.strain_energy_rate(_STRETCH, p) / np.expm1(3 * _LOG_STRETCH)
            slopes = np.array(np.broadcast_to(slopes, (n, len(_STRETCH))))
            near = [slopes[:, _UNSTRETCHED + k] + slopes[:, _UNSTRETCHED - k] for k in (1, 2, 3, 4)]
            slopes[:, _UNSTRETCHED] = sum(w * s for w, s in zip(_ACROSS, near, strict=True))
            from_halo = _UNSTRETCHED - (len(_STRETCH) - GRID.cells - 1) // 2
            return np.asarray(from_slopes(slopes, GRID.step, from_halo))

    def elastic_stress(self, stretch: Array, values: Mapping[str, Array]) -> Array:
        """J_e at ``stretch`` (N, K) for N members, Pa, from the same table the solver uses."""
        return np.asarray(evaluate(self.table(values), GRID.span, np.log(stretch)))


def get_law(name: str) -> ConstitutiveLaw:
    """The built-in law called ``name``. Raises :class:`ConfigError` with a suggestion."""
    if name not in REGISTRY:
        close = get_close_matches(name, REGISTRY, n=1)
        hint = f"; did you mean '{close[0]}'?" if close else ""
        raise ConfigError(f"unknown law '{name}'{hint} (there are: {', '.join(sorted(REGISTRY))})")
    return REGISTRY[name]()
