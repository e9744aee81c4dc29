"""Depth and normal networks in ONNX files that YAML files describe."""
