"""The contract of the three kinds, on a stand-in that reads painted views."""

from mpsfm_core.testing import contract_tests

test_depth = contract_tests("depth", "compact")
test_normals = contract_tests("normals", "compact")
test_mask = contract_tests("mask", "compact")
