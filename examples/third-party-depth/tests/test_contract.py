"""The contract of MP-SfM."""

from mpsfm_core.testing import contract_tests

test_contract = contract_tests("depth", "ridge-depth")
