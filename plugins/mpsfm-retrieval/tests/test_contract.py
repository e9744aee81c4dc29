"""The contract: the network on a stand-in, the other descriptor as it is."""

from mpsfm_core.testing import contract_tests

test_global_onnx = contract_tests("retrieval", "global-onnx")
test_appearance = contract_tests("retrieval", "appearance")
