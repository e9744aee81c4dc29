"""Prior-aware incremental mapper, without file access, plugins or console output."""
