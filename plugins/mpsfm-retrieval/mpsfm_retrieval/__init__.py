"""Global image descriptors from a network, or from local features and colors."""
