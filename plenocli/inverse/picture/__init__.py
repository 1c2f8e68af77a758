"""Pictures behind lenslets from a system matrix: least squares, LMMSE, priors over the whole
sensor, the trial of methods.

Sparse coding is sparse, training statistics are prior.
"""
