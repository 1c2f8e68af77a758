"""The paraxial models: the spread function at the array, square and shaped lenslets, pixels.

The exact kernel stands beside it (exact).
"""
