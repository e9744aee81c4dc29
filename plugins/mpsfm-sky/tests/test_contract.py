"""Provider contract tests of a small sky network and of the rule-based mask."""

from mpsfm_core.testing import contract_tests

test_sky = contract_tests("mask", "sky")
test_sky_simple = contract_tests("mask", "sky-simple")
