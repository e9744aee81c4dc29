"""Calibration of the uncertainty of depth and normal priors, with a report."""
