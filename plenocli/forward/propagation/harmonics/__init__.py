"""Exact propagation behind round lenslets by angular harmonics about their centres, where a
rotation changes nothing: every harmonic goes from the main lens to the sensor by itself.
"""
