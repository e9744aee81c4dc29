"""Viewer of reconstructions in the browser, with viser."""
