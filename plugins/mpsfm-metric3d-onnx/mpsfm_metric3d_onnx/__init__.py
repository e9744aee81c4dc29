"""Depth and normals from Metric3D v2 in an ONNX file."""
