"""RoMa in an ONNX file: a dense warp as matches."""
