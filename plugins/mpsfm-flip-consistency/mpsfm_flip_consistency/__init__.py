"""Variance of depth and normals from a second network pass on the mirrored image."""
