"""What stands between a capture and its calibration: motion, offsets, stray light.

Finding a grid from nothing is grid.
"""
