"""Benchmarks of the accuracy, time and memory of MP-SfM."""
