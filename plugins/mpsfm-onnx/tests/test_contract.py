"""Provider contract tests with small ONNX networks."""

from mpsfm_core.testing import contract_tests

test_depth = contract_tests("depth", "onnx")
test_normals = contract_tests("normals", "onnx")
test_joint_depth = contract_tests("depth", "onnx-joint")
test_joint_normals = contract_tests("normals", "onnx-joint")
test_moge_depth = contract_tests("depth", "moge-2-small")
test_moge_normals = contract_tests("normals", "moge-2-small")
