"""Reconstructions as rerun recordings."""
