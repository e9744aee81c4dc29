"""Reconstructions in the browser, with viser."""
