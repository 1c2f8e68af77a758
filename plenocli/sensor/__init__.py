"""Detector: noise, colour filter array, lenslet grid, superpixels. Arrays in, arrays out; no files."""
