"""A camera calibrated: its type, and what makes one of white, dark and narrow-band captures.

Where lenslets are is found in grid; what a calibration serves for is spectra.
"""
