"""RoMa in an ONNX file, as a matcher that predicts a dense warp."""
