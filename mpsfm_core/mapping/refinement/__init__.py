"""Bundle adjustment, depth refinement, point filtering, and measurement of noise."""
