"""SuperPoint, DISK and LightGlue with ONNX Runtime."""
