"""Numerical optimization: depth integration, bundle adjustment and covariances."""
