"""Inverse problems: least squares, non-negative, LMMSE, l1, dictionary; spectral demultiplexing."""
