"""Commands that model a camera.

Parsing and printing only.
"""
