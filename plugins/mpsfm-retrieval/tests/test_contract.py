"""Contract tests: the network with a stand-in, and the descriptor without weights."""

from mpsfm_core.testing import contract_tests

test_global_onnx = contract_tests("retrieval", "global-onnx")
test_appearance = contract_tests("retrieval", "appearance")
