"""plenocli: an end-to-end model of plenoptic (light-field) cameras as a chain of
file-based commands.
"""

__version__ = "0.1.0"
