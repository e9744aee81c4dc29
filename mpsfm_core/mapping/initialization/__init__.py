"""Initialization of a component: from an image pair, or from all images at once."""
