"""The contract, on a stand-in that matches by the pixels around each pixel."""

from mpsfm_core.testing import contract_tests

test_dense = contract_tests("matcher", "mast3r")
test_sparse = contract_tests("matcher", "mast3r-sparse")
