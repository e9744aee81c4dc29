"""Built-in providers, which need no download."""
