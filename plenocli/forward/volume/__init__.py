"""Volumes before lenslets: how the light of points at several depths lands on the superpixels."""
