"""Reconstructions as recordings of the viewer rerun."""
