"""Small network with weights in the package for metric depth, normals, variance and a mask."""
