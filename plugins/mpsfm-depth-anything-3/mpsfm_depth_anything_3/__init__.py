"""Depth Anything 3 as an MP-SfM provider."""
