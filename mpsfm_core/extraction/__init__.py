"""Extraction of features, image pairs, verified matches and priors by providers."""
