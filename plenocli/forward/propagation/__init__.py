"""From an object point to pixels: the models of propagation and the system matrix
that they compute.

Which model serves is chosen in accuracy; no files, no inversion.
"""
