"""Provider contract tests with a small network that matches patches instead of RoMa."""

from mpsfm_core.testing import contract_tests

test_dense = contract_tests("matcher", "roma")
test_sparse = contract_tests("matcher", "roma-sparse")
