"""Sequential assimilation of a long series, and the twin experiments that judge it."""
