"""Comparison of our providers with the networks' original code, on the same random weights.

``python -m benchmarks.conformance [NETWORK ...] --checkouts DIR``; see :mod:`__main__`.
"""
