"""Provider contract tests with a small network that replaces DSINE."""

from mpsfm_core.testing import contract_tests

test_dsine = contract_tests("normals", "dsine")
