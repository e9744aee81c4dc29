"""Export of neural networks to ONNX from the code and weights of their authors.

A plugin script, which uses :mod:`author_script`, runs the authors' code in a process of its own.
The MP-SfM process, with the module :mod:`export`, only compares the outputs of the ONNX file with
those of the original network.
"""
