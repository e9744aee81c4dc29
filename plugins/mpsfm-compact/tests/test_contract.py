"""Contract tests of the compact depth, normals, mask and camera with replacement networks."""

from mpsfm_core.testing import contract_tests

test_depth = contract_tests("depth", "compact")
test_normals = contract_tests("normals", "compact")
test_mask = contract_tests("mask", "compact")
test_camera = contract_tests("camera", "compact")
