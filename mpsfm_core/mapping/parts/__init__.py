"""Mapping in overlapping parts, whose reconstructions are joined."""
