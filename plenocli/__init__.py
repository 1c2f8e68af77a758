"""plenocli: an end-to-end model of plenoptic (light-field) cameras, as commands over files."""

__version__ = "0.2.0"
