"""MASt3R in an ONNX file, as a matcher that also predicts the depth of an image pair."""
