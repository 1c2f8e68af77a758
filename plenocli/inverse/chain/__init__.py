"""From a camera to a picture at the least cost: chains of a system matrix and a method, what each
is predicted to cost and to lose, and which one serves.
"""
