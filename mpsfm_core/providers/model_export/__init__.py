"""Export of networks to ONNX from the authors' code and weights.

The authors' code runs in its own process, in a script of a plugin that uses :mod:`author_script`.
The MP-SfM process (:mod:`export`) only compares the ONNX file with the outputs of the original
network.
"""
