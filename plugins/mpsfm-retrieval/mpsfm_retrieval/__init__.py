"""Global image descriptors, from a network or without weights."""
