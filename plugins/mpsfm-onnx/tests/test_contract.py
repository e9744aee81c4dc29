"""The contract, on a stand-in that reads painted views."""

from mpsfm_core.testing import contract_tests

test_depth = contract_tests("depth", "onnx")
test_joint = contract_tests("depth", "onnx-joint")
test_normals = contract_tests("normals", "onnx")
