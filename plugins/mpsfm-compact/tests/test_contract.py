"""Provider contract tests of the compact depth, normals and mask with a replacement network."""

from mpsfm_core.testing import contract_tests

test_depth = contract_tests("depth", "compact")
test_normals = contract_tests("normals", "compact")
test_mask = contract_tests("mask", "compact")
