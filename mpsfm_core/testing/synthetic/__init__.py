"""Synthetic scenes with exact cameras, depth, normals and matches."""
