"""Measured data: observations, the series they consist of, kinds of observation errors."""
