"""Any depth or normal network in an ONNX file, described in YAML, as an MP-SfM provider."""
