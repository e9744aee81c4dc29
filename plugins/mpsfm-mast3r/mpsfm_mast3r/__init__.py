"""MASt3R in an ONNX file: matches and depth of image pairs."""
