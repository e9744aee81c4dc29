"""Benchmarks of the accuracy, time and memory of MP-SfM."""

import mpsfm_core  # noqa: F401  (loads Python's zlib before pycolmap)
