"""Contract checks, one module for each provider kind."""
