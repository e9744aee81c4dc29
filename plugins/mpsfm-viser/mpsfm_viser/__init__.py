"""Reconstructions in the browser, by viser."""
