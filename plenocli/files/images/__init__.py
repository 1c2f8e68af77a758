"""EXR, camera RAW, DNG and photographs, in and out.

Artefacts of our own are artefacts.
"""
