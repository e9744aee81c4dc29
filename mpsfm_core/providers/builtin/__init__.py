"""Providers that need no download."""
