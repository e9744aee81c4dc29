"""Provider contract tests of tiny models with random weights."""

from mpsfm_core.testing import contract_tests

test_depth = contract_tests("depth", "transformers")
test_prompt = contract_tests("depth", "prompt-depth-anything")
test_superpoint = contract_tests("features", "superpoint-hub")
test_lightglue = contract_tests("matcher", "lightglue-superpoint-hub")
test_superglue = contract_tests("matcher", "superglue")
test_efficient_loftr = contract_tests("matcher", "efficient-loftr")
test_dino = contract_tests("retrieval", "dino")
