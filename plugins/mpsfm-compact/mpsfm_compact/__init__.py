"""A small network of our own: metric depth, normals, their uncertainty and validity."""
