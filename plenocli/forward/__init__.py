"""The forward model: camera and scene to what the sensor records, with its error and its cost.

Arrays and types in and out; no files, no estimation.
"""
