"""Contract checks of providers, in one module for each provider kind."""
