"""Volumes from one exposure: solvers over a map that repeats from lenslet to lenslet."""
