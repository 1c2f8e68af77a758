"""Volumes before lenslets: the field of a point at any depth, kernels by rays and waves, and what
is recorded of specimens (docs/model.md, "Volumes").
"""
