"""Bundle adjustment, depth integration, filtering, and the noise they assume."""
