"""From a file to a type: cameras, captures, scenes, system matrices, results.

Formats are one room up; nothing is written here.
"""
