"""Random rooms, streets and objects, rendered by ray casting."""
