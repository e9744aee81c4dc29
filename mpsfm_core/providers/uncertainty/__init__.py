"""Uncertainty models of depth and normal priors, and the files that store them."""
