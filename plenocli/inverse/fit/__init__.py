"""A camera that fits itself to its captures: a matrix that knows its derivatives, the likelihood
of captures, and the ascent that finds the camera and says how sure it is.
"""
