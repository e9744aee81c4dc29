"""Provider contract tests of both retrieval providers, with a small network."""

from mpsfm_core.testing import contract_tests

test_global_onnx = contract_tests("retrieval", "global-onnx")
test_appearance = contract_tests("retrieval", "appearance")
