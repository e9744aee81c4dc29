"""Depth of indoor photos by ridge regression on random features."""
