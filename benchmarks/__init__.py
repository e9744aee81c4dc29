"""Benchmarks of accuracy, time and memory."""
