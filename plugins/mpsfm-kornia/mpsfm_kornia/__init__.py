"""Local features and matchers of kornia as MP-SfM providers."""
