"""The numerical engines: depth integration, bundle adjustment, covariances."""
