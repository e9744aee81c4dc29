"""Runs the extraction on workers of Ray."""
