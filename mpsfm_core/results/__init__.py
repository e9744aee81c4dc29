"""Writes result folders, COLMAP models and exports to the formats of other programs."""
