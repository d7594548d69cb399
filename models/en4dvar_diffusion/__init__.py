"""A test-bed for fields: heads of a groundwater aquifer, and the conductivity that is estimated from them."""

from en4dvar_diffusion.aquifer import Aquifer, gaussian_fields

__all__ = ["Aquifer", "gaussian_fields"]
