"""The contract of the masks: the network on a stand-in, the rule of thumb as it is."""

from mpsfm_core.testing import contract_tests

test_sky = contract_tests("mask", "sky")
test_sky_simple = contract_tests("mask", "sky-simple")
