"""Sky masks, by a network or without weights."""
