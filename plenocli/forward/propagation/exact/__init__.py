"""The exact scalar model: Rayleigh and Sommerfeld's kernel as low rank products.

Paraxial optics stands beside it (fresnel).
"""
