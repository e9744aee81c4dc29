"""Local features and matchers of kornia."""
