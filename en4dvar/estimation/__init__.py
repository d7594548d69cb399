"""From problem to result: one data set, many that share parameters, populations, planned experiments."""
