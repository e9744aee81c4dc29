"""The prior-aware incremental mapper: pure numerics, no files, no plugins, no printing."""
