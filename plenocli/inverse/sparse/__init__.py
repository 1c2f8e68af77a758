"""Sparse reconstruction: dictionary learning for incoherent sampling and its parts.

The l1 solver has its own folder (l1).
"""
