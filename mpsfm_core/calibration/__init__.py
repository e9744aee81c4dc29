"""Fitting the uncertainty of a prior, and the report on it."""
