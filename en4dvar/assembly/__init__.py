"""Settings and files become problems: data files are found and read, priors and models put together."""
