"""What is kept: results as netCDF, checkpoints, seals, provenance, tables."""
