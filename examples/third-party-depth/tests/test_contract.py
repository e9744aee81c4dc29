"""Contract tests of MP-SfM for the depth provider ridge-depth."""

from mpsfm_core.testing import contract_tests

test_contract = contract_tests("depth", "ridge-depth")
