"""The white target that captures are referred to."""

REFERENCE_REFLECTANCE = 0.99
"""Of the white reference target, as the paper's Labsphere (Spectralon 99%), flat over the visible:
what capture-sim shows and demux and score divide by, unless told otherwise.
"""
