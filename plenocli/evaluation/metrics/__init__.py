"""Figures of merit: image quality, spectral accuracy, signal to noise, coherence, depth.

Arrays in, numbers out.
"""
