"""Runs the extraction on workers of Dask."""
