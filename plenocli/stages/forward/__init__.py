"""The commands that model a camera.

simulate-pif, simulate-response, capture-sim, lens.
"""
