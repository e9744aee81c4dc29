"""The contract, on a stand-in that matches by the pixels around each pixel of a coarse grid."""

from mpsfm_core.testing import contract_tests

test_dense = contract_tests("matcher", "roma")
test_sparse = contract_tests("matcher", "roma-sparse")
