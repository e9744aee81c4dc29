"""Uncertainty of depth and normals from a second pass on the mirrored image."""
