"""Contract tests with a stand-in network."""

from mpsfm_core.testing import contract_tests

test_dsine = contract_tests("normals", "dsine")
