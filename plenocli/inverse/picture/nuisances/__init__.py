"""What a capture holds beyond A x and noise, found in its superpixels and taken out before any
method: defective and saturated pixels, and light that lies evenly over a superpixel.
"""
