"""Compares reconstructions with ground truth."""
