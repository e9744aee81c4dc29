"""Contract tests with a stand-in that matches patches."""

from mpsfm_core.testing import contract_tests

test_dense = contract_tests("matcher", "mast3r")
test_sparse = contract_tests("matcher", "mast3r-sparse")
