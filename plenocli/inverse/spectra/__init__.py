"""Spectra behind lenslets: the response matrix measured, shared or cleaned, and its inverse.

Pictures behind lenslets are picture.
"""
