"""Metric3D v2 depth and normals with ONNX Runtime."""
