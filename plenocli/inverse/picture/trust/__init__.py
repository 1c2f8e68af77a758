"""Whether a capture and its system matrix belong together: what the capture itself says of the
matrix, and the noise that follows from it.
"""
