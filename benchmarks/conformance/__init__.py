"""Comparison of our adapters with the authors' code on the same random weights and photos.

``python -m benchmarks.conformance [NETWORK ...] --checkouts DIR``; see :mod:`__main__`.
"""
