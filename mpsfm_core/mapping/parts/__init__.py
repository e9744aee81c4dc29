"""Mapping in overlapping parts: partition of the match graph, joining of the reconstructions."""
