"""The commands that turn captures into results.

calibrate, demux, learn-dict, reconstruct, refocus.
"""
