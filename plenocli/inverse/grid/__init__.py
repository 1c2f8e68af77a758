"""Where the lenslets are: lattices found in a white image, to a fraction of a pixel.

How a later capture moved against it is registration.
"""
