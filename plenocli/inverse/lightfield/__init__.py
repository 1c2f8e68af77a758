"""Views, refocused planes and depth from one capture.

Geometry comes from forward.camera.
"""
