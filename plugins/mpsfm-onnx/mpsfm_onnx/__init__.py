"""Depth and normal networks in ONNX files, described in YAML."""
