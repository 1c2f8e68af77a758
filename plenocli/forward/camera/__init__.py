"""The camera: its description in SI units, first-order geometry, glass, lenses, the pupil.

No light is carried to the sensor here; that is propagation.
"""
