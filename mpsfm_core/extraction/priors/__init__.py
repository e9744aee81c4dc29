"""Depth and normal priors on the grid of the mapper."""
