"""Descriptions as TOML, both ways: camera, lens, scene, sweep.

The types they fill live in forward.
"""
