"""Reads images, cameras, masks, poses, matches and videos; one module for each source."""
