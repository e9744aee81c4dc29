"""Small network with weights in the package: metric depth, normals, their variance and a mask."""
