"""Writes reconstructions in the formats other tools read, and the report."""
