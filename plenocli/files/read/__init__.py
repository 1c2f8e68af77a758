"""From a file to a type: cameras, captures, scenes, system matrices, results.

Formats are one room up. Nothing is written here but what one module reads and writes: calibrations.
"""
