"""Export of networks that are not published as ONNX files, from their authors' code and weights.

The authors' code runs in its own process, with the script of a plugin that uses
:mod:`author_script`. This process (:mod:`export`) only compares the file with the output of the
original network.
"""
