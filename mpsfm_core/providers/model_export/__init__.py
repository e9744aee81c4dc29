"""Export of unpublished ONNX files from the authors' code and weights of a network.

The authors' code runs in its own process, with the script of a plugin that uses
:mod:`author_script`. This process (:mod:`export`) only compares the file with the output of the
original network.
"""
