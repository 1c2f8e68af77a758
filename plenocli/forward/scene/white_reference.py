"""The white target that captures are referred to."""

REFERENCE_REFLECTANCE = 0.99
"""Of the white reference target, as the paper's Labsphere (Spectralon 99%), flat over the visible:
what capture-sim shows and demux and score divide by, unless told otherwise.
"""
WHITE_LEVEL = 0.8
"""Share of full well that a perfect white reaches in the camera's white exposure, at the brightest
pixel.
"""
