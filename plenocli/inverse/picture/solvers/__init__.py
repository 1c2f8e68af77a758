"""Solvers of y = A x + noise on arrays: least squares, LMMSE, a denoiser, plug and play.

They know matrices, signals and statistics; how a capture is treated is decided one room up.
"""
