"""Run a reconstruction: the only package that uses all others."""
