"""Contract tests with a stand-in that matches patches on a coarse grid."""

from mpsfm_core.testing import contract_tests

test_dense = contract_tests("matcher", "roma")
test_sparse = contract_tests("matcher", "roma-sparse")
