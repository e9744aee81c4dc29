"""Global image descriptors, by a network or without weights."""
