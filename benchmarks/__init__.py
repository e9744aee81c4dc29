"""Performance and accuracy measurements, kept apart from the tests."""
