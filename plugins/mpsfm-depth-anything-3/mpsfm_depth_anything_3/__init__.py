"""Depth Anything 3 as a provider of depth, poses and intrinsics for groups of images."""
