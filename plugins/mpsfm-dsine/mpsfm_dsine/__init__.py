"""DSINE surface normals from an ONNX file."""
