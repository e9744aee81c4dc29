"""DSINE surface normals in an ONNX file."""
