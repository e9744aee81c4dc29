"""Provider contract tests of the wrapper around depth and normals providers."""

from mpsfm_core.testing import contract_tests

test_flip_consistency = contract_tests("wrapper", "flip-consistency")
