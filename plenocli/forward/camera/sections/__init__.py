"""The tables of a camera file as types, each checked by itself.

What several of them must agree about is checked by `forward.camera.model`.
"""
