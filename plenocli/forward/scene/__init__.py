"""What stands before the camera: pictures, charts, light sources, spectral quadrature and tables.

No files (files.read) and no detector (sensor).
"""
