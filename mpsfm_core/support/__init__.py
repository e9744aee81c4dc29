"""Utilities without SfM code: files, arrays on disk, YAML, numba kernels and threads."""
