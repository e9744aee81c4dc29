"""Scene of the mapper (poses, tracks, depth maps) and its conversion to a reconstruction."""
