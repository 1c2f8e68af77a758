"""The methods of reconstruct: each an object with its name, its needs and its estimate.

What solves equations is in solvers, what all methods share one room up.
"""
