"""Incremental mapper with depth and normal priors, without file access or plugins."""
