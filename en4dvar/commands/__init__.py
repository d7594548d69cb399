"""The commands of ``en4dvar``, one module each. Heavy imports stay inside them, so that ``--help`` answers at once."""
