"""How a posterior responds to what is held to be true: other physics, other scales, and a modulus that varied."""
