"""Our adapters against the authors' code: same random weights, same photos, same answers.

``python -m benchmarks.conformance [NETWORK ...] --checkouts DIR``; see :mod:`__main__`.
"""
