"""The contract, on a stand-in that reads painted views."""

from mpsfm_core.testing import contract_tests

test_dsine = contract_tests("normals", "dsine")
