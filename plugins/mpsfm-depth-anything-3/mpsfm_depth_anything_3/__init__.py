"""Depth Anything 3 as a multi-view provider."""
