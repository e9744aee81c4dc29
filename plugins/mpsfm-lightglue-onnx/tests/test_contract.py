"""Provider contract tests with a blob detector and a mutual nearest-neighbor matcher."""

from mpsfm_core.testing import contract_tests

test_superpoint = contract_tests("features", "superpoint")
test_disk = contract_tests("features", "disk-onnx")
test_lightglue = contract_tests("matcher", "lightglue-superpoint")
