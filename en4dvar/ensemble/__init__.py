"""The members of an ensemble: their paths, their forecast, their moments."""
