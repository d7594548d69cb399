"""Prior distributions: parameters and their maps, dependence, fields, variation in time."""
