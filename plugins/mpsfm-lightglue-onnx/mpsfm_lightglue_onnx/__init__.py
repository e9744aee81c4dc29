"""SuperPoint, DISK and LightGlue in ONNX files."""
