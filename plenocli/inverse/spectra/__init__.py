"""Spectra behind lenslets: the response matrix of a calibration and its inverse.

Pictures behind lenslets are picture.
"""
