"""Where files meet types: artefacts, images, configurations, and what reads each
of them into a type.

No mathematics beyond units; the only room besides stages that opens a file.
"""
