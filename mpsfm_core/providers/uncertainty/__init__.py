"""Uncertainty of priors: the model of the standard deviation and its calibration files."""
