"""Selection of the image pairs that are matched."""
