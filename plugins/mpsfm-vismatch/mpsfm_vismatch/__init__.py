"""Matchers of vismatch, a collection of matching networks in torch."""
