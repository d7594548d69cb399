"""A test-bed for fields: heads of a groundwater aquifer, and the conductivity that is estimated from them."""

from en4dvar_diffusion.aquifer import Aquifer

__all__ = ["Aquifer"]
