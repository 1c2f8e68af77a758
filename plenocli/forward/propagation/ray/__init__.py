"""Geometric optics: what rays carry into each pixel, as exact areas.

No waves here (fresnel, exact).
"""
