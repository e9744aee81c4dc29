"""Provider contract tests with a small network that matches patches instead of MASt3R."""

from mpsfm_core.testing import contract_tests

test_dense = contract_tests("matcher", "mast3r")
test_sparse = contract_tests("matcher", "mast3r-sparse")
