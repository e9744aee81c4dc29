"""Bundle adjustment, depth refinement, filtering, and measurement of their noise."""
