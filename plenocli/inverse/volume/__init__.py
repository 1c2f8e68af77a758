"""Volumes from one exposure: solvers over a map that repeats from lenslet to lenslet.

Each is given a Problem (a map, a measurement, voxels, pixels put aside) and gives a Volume.
"""
