"""Networks that nobody publishes as a file, made from their authors' code and weights.

The code runs in a process of its own (:mod:`authors` is what a plugin's script uses there); nothing
of it enters this one, which checks the file against what the network said (:mod:`run`).
"""
