"""Matching, geometric verification and keypoint adjustment of image pairs."""
