"""Sky masks, from a network or without weights."""
