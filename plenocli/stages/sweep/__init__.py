"""The commands that explore a design space: its points, their results, the table and the front.

A point runs the other stages; it computes nothing itself.
"""
