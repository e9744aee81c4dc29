from mpsfm_core.testing import hook_tests

test_hooks = hook_tests("$name")
