"""Structure-from-Motion with monocular depth and normal priors from swappable plugins."""
