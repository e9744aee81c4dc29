"""Surface normals from DSINE in an ONNX file."""
