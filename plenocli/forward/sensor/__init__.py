"""The detector: colour filters, noise, frames, superpixels cut from a mosaic, light
through a system matrix.

Where lenslets are is estimated elsewhere (inverse.grid).
"""
