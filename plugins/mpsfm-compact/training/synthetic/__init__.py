"""Random rooms, streets and table tops, rendered by ray casting for training."""
