"""Local features and matchers from the library kornia."""
